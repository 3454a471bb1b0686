/* Steps one Model Exchange instance of FMI 1.0, 2.0 or 3.0 without Python: integrates its states with CVODE from one
 * communication point to the next, with state, time and step events located and handled.
 *
 * Compiled in one unit behind adapter.c, whose Slave it sets inputs and gets outputs by. CVODE is called by address:
 * its libraries come with FMPy. Inputs are held over a communication step; where they changed, the step begins with an
 * event, since a jump is one. No evaluation lies beyond the communication step. After an event the integration starts
 * anew; else it goes on over communication points with its history. The structs are mirrored in exchange.py.
 */

enum { CV_TSTOP_RETURN = 1, CV_ROOT_RETURN = 2, CV_ONE_STEP = 2, CV_REPTD_RHSFUNC_ERR = -10, CV_RHSFUNC_FAIL = -8 };
/* What is more than these is an error with a name, not a longer wait. */
enum { EVENTS_AT_ONCE = 1000 };
#define AT_ONCE 1e-7 /* of a communication step: events this near to the one before count as of one instant */

typedef struct {
    int (*context_create)(int, void **);
    int (*clear_error_handlers)(void *);
    int (*push_error_handler)(void *, void (*)(int, const char *, const char *, const char *, int, void *, void *),
                              void *);
    int (*context_free)(void **);
    void *(*vector_new)(int64_t, void *);
    double *(*vector_data)(void *);
    void (*vector_destroy)(void *);
    void *(*matrix_new)(int64_t, int64_t, void *);
    void (*matrix_destroy)(void *);
    void *(*linear_solver_new)(void *, void *, void *);
    int (*linear_solver_free)(void *);
    void *(*create)(int, void *);
    int (*init)(void *, int (*)(double, void *, void *, void *), double, void *);
    int (*reinit)(void *, double, void *);
    int (*tolerances)(void *, double, void *);
    int (*root_init)(void *, int, int (*)(double, void *, double *, void *));
    int (*set_linear_solver)(void *, void *, void *);
    int (*set_user_data)(void *, void *);
    int (*set_max_step)(void *, double);
    int (*set_stop_time)(void *, double);
    int (*no_inactive_root_warning)(void *);
    int (*solve)(void *, double, void *, double *, int);
    void (*destroy)(void **);
} Solver;

typedef struct {
    Slave *slave;
    const Solver *solver;
    int version, method;
    double tolerance, max_step;
    size_t states, indicators;
    Function set_time, set_states, get_states, get_derivatives, get_indicators, get_nominals;
    Function completed_step; /* NULL: the FMU says it needs none */
    Function enter_event_mode, update_states, enter_continuous_mode;
    Function initialise;                     /* FMI 1's */
    Clocks clocks;                           /* FMI 3's */
    double *last_inputs;                     /* as they were set last */
    size_t inputs;
    double *values;                          /* of the indicators, one place for each */
    unsigned char *domains;                  /* z > 0 when an event was last handled */
    void *context, *vector, *tolerances, *matrix, *linear, *memory; /* of CVODE */
    double time, next_event, last_event;
    int next_event_defined, restart, status, not_finite;
    long crowd;                              /* events that came at once */
    int64_t events, steps;
    char complaint[256];                     /* CVODE's last */
} Exchange;

typedef struct {
    int again, terminate, nominals_changed, values_changed, next_defined;
    double next;
} Update; /* as FMI 2 has it */
typedef struct {
    char converged, references_changed, values_changed, terminate, next_defined;
    double next;
} Update1;

#define INSTANCE e->slave->instance
#define CALL(function, ...) ((function)(__VA_ARGS__))

static int told(Exchange *e, int status, const char *format, ...)
{
    Entry *entry = new_entry(e->slave, status, "model exchange");
    va_list arguments;
    va_start(arguments, format);
    mark_cut(entry, vsnprintf(entry->message, MESSAGE_SIZE, format, arguments));
    va_end(arguments);
    return ended(e->slave, status, STEPPING);
}

static void complain(int line, const char *function, const char *file, const char *message, int code, void *self,
                     void *context)
{
    (void)line; (void)file; (void)code; (void)context;
    Exchange *e = self;
    snprintf(e->complaint, sizeof e->complaint, "%s: %s", function ? function : "", message ? message : "");
}

/* ---- evaluation ---- */

static int set_point(Exchange *e, double t, const double *x)
{
    int status = ((int (*)(void *, double))e->set_time)(INSTANCE, t);
    if (!fine(status) || !e->states)
        return status;
    return ((int (*)(void *, const double *, size_t))e->set_states)(INSTANCE, x, e->states);
}

static int get_vector(Exchange *e, Function function, double *values, size_t n)
{
    return n ? ((int (*)(void *, double *, size_t))function)(INSTANCE, values, n) : OK;
}

/* What CVODE wants to hear: a discard may pass with a shorter step, an error may not. */
static int judged(Exchange *e, int status, const double *values, size_t n)
{
    e->status = status;
    if (!fine(status))
        return status == DISCARD ? 1 : -1;
    for (size_t i = 0; i < n; i++)
        if (!isfinite(values[i])) {
            e->not_finite = (int)i + 1;
            return 1;
        }
    e->not_finite = 0;
    return 0;
}

static int rates(double t, void *y, void *ydot, void *self)
{
    Exchange *e = self;
    double *rate = e->solver->vector_data(ydot);
    rate[0] = 0.0; /* stays so where there are no states: then one stands in that does not move */
    int status = set_point(e, t, e->solver->vector_data(y));
    if (fine(status))
        status = get_vector(e, e->get_derivatives, rate, e->states);
    return judged(e, status, rate, e->states);
}

static int roots(double t, void *y, double *z, void *self)
{
    Exchange *e = self;
    int status = set_point(e, t, e->solver->vector_data(y));
    if (fine(status))
        status = get_vector(e, e->get_indicators, z, e->indicators);
    return judged(e, status, z, 0) ? -1 : 0;
}

/* ---- events ---- */

static int update(Exchange *e, Update *now)
{
    int status;
    if (e->version == 1) {
        Update1 old = {0};
        status = ((int (*)(void *, char, Update1 *))e->update_states)(INSTANCE, 0, &old);
        *now = (Update){!old.converged, old.terminate, old.references_changed, old.values_changed, old.next_defined,
                        old.next};
    } else if (e->version == 2) {
        status = ((int (*)(void *, Update *))e->update_states)(INSTANCE, now);
    } else {
        bool again = false, terminate = false, nominals = false, values = false, defined = false;
        double next = 0.0;
        status = ((int (*)(void *, bool *, bool *, bool *, bool *, bool *, double *))e->update_states)(
            INSTANCE, &again, &terminate, &nominals, &values, &defined, &next);
        *now = (Update){again, terminate, nominals, values, defined, next};
    }
    return status;
}

static int plain(Exchange *e, Function function)
{
    return function ? ((int (*)(void *))function)(INSTANCE) : OK;
}

static int asked_to_end(Exchange *e)
{
    e->slave->terminated = 1;
    e->slave->last_successful_time = e->time;
    return ended(e->slave, DISCARD, STEPPING);
}

static int set_tolerances(Exchange *e)
{
    double *nominals = e->solver->vector_data(e->tolerances);
    nominals[0] = 1.0;
    int status = get_vector(e, e->get_nominals, nominals, e->states);
    for (size_t i = 0; i < (e->states ? e->states : 1); i++) {
        double nominal = fabs(nominals[i]);
        nominals[i] = e->tolerance * (fine(status) && nominal > 0.0 && isfinite(nominal) ? nominal : 1.0);
    }
    return fine(status) || status == DISCARD ? OK : status;
}

static int mark_domains(Exchange *e)
{
    int status = get_vector(e, e->get_indicators, e->values, e->indicators);
    for (size_t i = 0; i < e->indicators; i++)
        e->domains[i] = e->values[i] > 0.0;
    return status;
}

static bool domain_changed(const Exchange *e)
{
    for (size_t i = 0; i < e->indicators; i++)
        if (e->domains[i] != (e->values[i] > 0.0))
            return true;
    return false;
}

/* In event mode: iterate until the FMU needs no new discrete states, then on in continuous time. */
static int settle(Exchange *e, Update now)
{
    int iterations = 0;
    bool nominals = true;
    e->events++;
    while (now.again) {
        if (now.terminate)
            return asked_to_end(e);
        if (++iterations > EVENT_ITERATIONS)
            return told(e, ERROR, "event iteration does not settle: after %d rounds at t = %.9g s the FMU still needs "
                        "new discrete states", EVENT_ITERATIONS, e->time);
        now = (Update){0};
        int status = update(e, &now);
        if (!fine(status))
            return ended(e->slave, status, STEPPING);
        nominals = nominals || now.nominals_changed;
    }
    if (now.terminate)
        return asked_to_end(e);
    e->next_event_defined = now.next_defined && isfinite(now.next);
    e->next_event = now.next;
    int status = plain(e, e->enter_continuous_mode);
    if (fine(status))
        status = get_vector(e, e->get_states, e->solver->vector_data(e->vector), e->states);
    if (fine(status) && nominals)
        status = set_tolerances(e);
    if (fine(status))
        status = mark_domains(e);
    e->restart = 1;
    return fine(status) ? OK : ended(e->slave, status, STEPPING);
}

static int handle_event(Exchange *e, double h, const double *u)
{
    e->crowd = fabs(e->time - e->last_event) <= AT_ONCE * h ? e->crowd + 1 : 0;
    e->last_event = e->time;
    if (e->crowd > EVENTS_AT_ONCE)
        return told(e, ERROR, "chattering: %d events in a row, each within %.3g s of the one before, up to t = %.9g s",
                    EVENTS_AT_ONCE, AT_ONCE * h, e->time);
    int status = plain(e, e->enter_event_mode);
    if (!fine(status))
        return ended(e->slave, status, STEPPING);
    if (u) {
        status = write_blocks(e->version, e->slave, e->slave->inputs, e->slave->inputs_end, u);
        if (status > WARNING)
            return status;
        memcpy(e->last_inputs, u, e->inputs * sizeof *u);
    }
    status = tick(&e->clocks, INSTANCE, e->time);
    return fine(status) ? settle(e, (Update){.again = 1}) : ended(e->slave, status, STEPPING);
}

/* Of what the FMU announced and the ticks of its clocks, the earliest. */
static double next_event(const Exchange *e)
{
    return fmin(e->next_event_defined ? e->next_event : INFINITY, next_tick(&e->clocks));
}

/* ---- integration ---- */

static void release_solver(Exchange *e)
{
    const Solver *s = e->solver;
    if (e->memory)
        s->destroy(&e->memory);
    if (e->linear)
        s->linear_solver_free(e->linear);
    if (e->matrix)
        s->matrix_destroy(e->matrix);
    e->memory = e->linear = e->matrix = NULL;
}

/* CVODE kept from one start to the next would be no saving worth its state: all is made anew. */
EXPORT void exchange_release(void *self)
{
    Exchange *e = self;
    const Solver *s = e->solver;
    release_solver(e);
    if (e->tolerances)
        s->vector_destroy(e->tolerances);
    if (e->vector)
        s->vector_destroy(e->vector);
    if (e->context)
        s->context_free(&e->context);
    e->tolerances = e->vector = e->context = NULL;
}

static int make_vectors(Exchange *e)
{
    const Solver *s = e->solver;
    int64_t n = e->states ? (int64_t)e->states : 1;
    if (s->context_create(0, &e->context))
        return -1;
    s->clear_error_handlers(e->context);
    s->push_error_handler(e->context, complain, e);
    e->vector = s->vector_new(n, e->context);
    e->tolerances = s->vector_new(n, e->context);
    if (!e->vector || !e->tolerances)
        return -1;
    s->vector_data(e->vector)[0] = 1.0;
    return 0;
}

static int make_solver(Exchange *e)
{
    const Solver *s = e->solver;
    int64_t n = e->states ? (int64_t)e->states : 1;
    e->memory = s->create(e->method, e->context);
    e->matrix = s->matrix_new(n, n, e->context);
    if (!e->memory || !e->matrix || s->init(e->memory, rates, e->time, e->vector) || s->set_user_data(e->memory, e))
        return -1;
    e->linear = s->linear_solver_new(e->vector, e->matrix, e->context);
    if (!e->linear || s->tolerances(e->memory, e->tolerance, e->tolerances))
        return -1;
    if (s->root_init(e->memory, (int)e->indicators, roots) || s->no_inactive_root_warning(e->memory))
        return -1;
    if (s->set_linear_solver(e->memory, e->linear, e->matrix))
        return -1;
    return e->max_step > 0.0 ? s->set_max_step(e->memory, e->max_step) : 0;
}

static int unsolved(Exchange *e, int flag)
{
    if (e->status > WARNING && e->status != DISCARD)
        return ended(e->slave, e->status, STEPPING);
    if (e->not_finite)
        return told(e, ERROR, "the derivative of state %d is not finite near t = %.9g s", e->not_finite, e->time);
    if (e->status == DISCARD)
        return told(e, DISCARD, "the FMU discards its derivatives near t = %.9g s, however short the step", e->time);
    return told(e, ERROR, "CVODE gave up at t = %.9g s with %d: %s", e->time, flag, e->complaint);
}

/* One step of the solver towards `stop`, at most; the FMU stands at the state reached. */
static int integrate(Exchange *e, double stop, bool *event)
{
    const Solver *s = e->solver;
    double negligible = rounding(stop, e->time);
    int flag = 0;
    if (stop - e->time <= negligible) { /* too short for a solver: nothing moves */
        e->time = stop;
        e->restart = 1;
    } else {
        if (e->restart) {
            if (e->memory ? s->reinit(e->memory, e->time, e->vector) : make_solver(e))
                return told(e, ERROR, "CVODE cannot start at t = %.9g s: %s", e->time, e->complaint);
            if (s->tolerances(e->memory, e->tolerance, e->tolerances))
                return told(e, ERROR, "CVODE refuses the tolerance %.3g: %s", e->tolerance, e->complaint);
            e->restart = 0;
        }
        e->status = OK;
        s->set_stop_time(e->memory, stop);
        flag = s->solve(e->memory, stop, e->vector, &e->time, CV_ONE_STEP);
        if (flag < 0)
            return unsolved(e, flag);
        if (stop - e->time <= negligible)
            e->time = stop;
    }
    e->steps++;
    int status = set_point(e, e->time, s->vector_data(e->vector));
    if (fine(status) && e->indicators)
        status = get_vector(e, e->get_indicators, e->values, e->indicators);
    if (!fine(status))
        return ended(e->slave, status, STEPPING);
    *event = flag == CV_ROOT_RETURN || domain_changed(e);
    return OK;
}

/* Tell the FMU that the step is accepted; it may want an event, or the end. */
static int completed(Exchange *e, bool *event)
{
    if (!e->completed_step)
        return OK;
    int status, wants_event = 0, terminate = 0;
    if (e->version == 1) {
        char wants = 0;
        status = ((int (*)(void *, char *))e->completed_step)(INSTANCE, &wants);
        wants_event = wants;
    } else if (e->version == 2) {
        status = ((int (*)(void *, int, int *, int *))e->completed_step)(INSTANCE, !e->slave->reversible,
                                                                           &wants_event, &terminate);
    } else {
        bool wants = false, end = false;
        status = ((int (*)(void *, bool, bool *, bool *))e->completed_step)(INSTANCE, !e->slave->reversible, &wants,
                                                                               &end);
        wants_event = wants;
        terminate = end;
    }
    if (!fine(status))
        return ended(e->slave, status, STEPPING);
    *event = *event || wants_event;
    return terminate ? asked_to_end(e) : OK;
}

static int advance_exchange(Exchange *e, double t, double h, const double *u, double *y)
{
    Slave *slave = e->slave;
    if (slave->failed)
        return slave->failed;
    slave->time = t;
    int status = OK;
    double end = t + h;
    e->time = t;
    if (e->inputs && memcmp(u, e->last_inputs, e->inputs * sizeof *u)) {
        status = set_point(e, t, e->solver->vector_data(e->vector));
        if (!fine(status))
            return ended(slave, status, STEPPING);
        status = handle_event(e, h, u);
    }
    while (status <= WARNING && e->time < end) {
        bool event = false;
        double next = next_event(e), stop = next < end + rounding(t, end) ? next : end;
        if (stop > e->time) {
            status = integrate(e, stop, &event);
            if (status <= WARNING)
                status = completed(e, &event);
            if (status > WARNING)
                break;
        }
        if (event || next_event(e) <= e->time)
            status = handle_event(e, h, NULL);
    }
    if (status > WARNING)
        return status;
    return read_blocks(e->version, slave, y);
}

EXPORT int exchange_step(void *self, double t, double h, const double *u, double *y)
{
    return advance_exchange(self, t, h, u, y);
}

/* After initialisation, in event mode: to continuous time, ready to be stepped from t0. */
EXPORT int exchange_start(void *self, double t0, const double *u, double *y)
{
    Exchange *e = self;
    exchange_release(e);
    e->time = t0;
    e->last_event = -INFINITY;
    e->crowd = e->events = e->steps = 0;
    e->next_event_defined = e->not_finite = 0;
    if (e->inputs)
        memcpy(e->last_inputs, u, e->inputs * sizeof *u);
    if (make_vectors(e))
        return told(e, ERROR, "CVODE cannot be set up: %s", e->complaint);
    Update now = {.again = 1};
    if (e->version == 1) {
        Update1 first = {0};
        int status = ((int (*)(void *, char, double, Update1 *))e->initialise)(INSTANCE, 1, e->tolerance, &first);
        if (!fine(status))
            return ended(e->slave, status, STEPPING);
        now = (Update){!first.converged, first.terminate, 0, first.values_changed, first.next_defined, first.next};
    }
    rewind_clocks(&e->clocks, t0);
    int status = tick(&e->clocks, INSTANCE, t0);
    status = fine(status) ? settle(e, now) : ended(e->slave, status, STEPPING);
    return status > WARNING ? status : read_blocks(e->version, e->slave, y);
}
