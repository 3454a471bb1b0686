/* Takes an instance back within an instant: its state kept and gone back to, and the derivatives of its outputs there.
 *
 * Compiled in one unit behind exchange.c. FMI 2 and FMI 3 have the same calls for a state, so that one function does
 * for both. What is known of the instance outside of it, by its solver and its clocks, is copied beside the FMU's
 * state. The struct is mirrored in reversal.py.
 */

enum { REGIONS = 10 };

typedef struct {
    Slave *slave;
    Exchange *exchange;    /* NULL but in Model Exchange */
    EventMode *event_mode; /* NULL but in Co-Simulation that hands over at events */
    int version;
    Function get_state, set_state, free_state;
    void *state;  /* the FMU's handle of the state kept */
    char *beside; /* what is kept beside it, one region after the other */
    Function derive;
    const uint32_t *knowns, *unknowns;
    const Conversion *inputs, *outputs; /* of each known, of each unknown: its place and the factor of its unit */
    size_t n_knowns, n_unknowns, n_outputs;
    double *seed, *found;
} Past;

typedef struct {
    void *place;
    size_t size;
} Region;

/* What changes with the steps and lies outside the FMU. */
static size_t regions(const Past *past, Region *region)
{
    Region *next = region;
    Exchange *e = past->exchange;
    EventMode *v = past->event_mode;
    if (e) {
        const Solver *s = e->solver;
        size_t states = e->states ? e->states : 1;
        *next++ = (Region){&e->time, sizeof e->time};
        *next++ = (Region){&e->next_event, sizeof e->next_event};
        *next++ = (Region){&e->last_event, sizeof e->last_event};
        *next++ = (Region){&e->next_event_defined, sizeof e->next_event_defined};
        *next++ = (Region){&e->crowd, sizeof e->crowd};
        *next++ = (Region){e->last_inputs, e->inputs * sizeof *e->last_inputs};
        *next++ = (Region){e->domains, e->indicators * sizeof *e->domains};
        *next++ = (Region){s->vector_data(e->vector), states * sizeof(double)};
        *next++ = (Region){s->vector_data(e->tolerances), states * sizeof(double)};
        *next++ = (Region){e->clocks.ticks, e->clocks.count * sizeof *e->clocks.ticks};
    } else if (v) {
        *next++ = (Region){v->last_inputs, v->inputs * sizeof *v->last_inputs};
        *next++ = (Region){v->clocks.ticks, v->clocks.count * sizeof *v->clocks.ticks};
    }
    return (size_t)(next - region);
}

static int impossible(Past *past, int stage, const char *what)
{
    Entry *entry = new_entry(past->slave, ERROR, "taking back");
    mark_cut(entry, snprintf(entry->message, MESSAGE_SIZE, "%s", what));
    return ended(past->slave, ERROR, stage);
}

static int copy_beside(Past *past)
{
    Region region[REGIONS];
    size_t count = regions(past, region), size = 0;
    for (size_t i = 0; i < count; i++)
        size += region[i].size;
    if (size && !past->beside && !(past->beside = malloc(size)))
        return impossible(past, KEEPING, "there is no memory left");
    char *to = past->beside;
    for (size_t i = 0; i < count; i++) {
        if (region[i].size)
            memcpy(to, region[i].place, region[i].size);
        to += region[i].size;
    }
    return OK;
}

/* A solver has a history that cannot be kept. From a kept state on it starts anew, the first time as after a return.
 * CVODE's own way to start anew leaves root functions asleep that rested at zero, so that it is made anew. */
static void begin_anew(Past *past)
{
    if (!past->exchange)
        return;
    release_solver(past->exchange);
    past->exchange->restart = 1;
}

EXPORT int fmu_keep(void *self)
{
    Past *past = self;
    Slave *slave = past->slave;
    if (slave->failed)
        return slave->failed;
    int status = ((int (*)(void *, void **))past->get_state)(slave->instance, &past->state);
    if (!fine(status))
        return ended(slave, status, KEEPING);
    if (!past->state)
        return impossible(past, KEEPING, "the FMU gave no state");
    begin_anew(past);
    int copied = copy_beside(past);
    return copied == OK ? status : copied;
}

/* Also after an error, which a state set again mends; not after a fatal. */
EXPORT int fmu_restore(void *self)
{
    Past *past = self;
    Slave *slave = past->slave;
    if (slave->failed == FATAL || !slave->instance)
        return slave->failed;
    if (!past->state)
        return impossible(past, RESTORING, "no state was kept");
    int status = ((int (*)(void *, void *))past->set_state)(slave->instance, past->state);
    if (!fine(status))
        return ended(slave, status, RESTORING);
    slave->failed = OK;
    slave->terminated = 0;
    slave->last_successful_time = NAN;
    Region region[REGIONS];
    size_t count = regions(past, region);
    const char *from = past->beside;
    for (size_t i = 0; i < count; i++) {
        if (region[i].size)
            memcpy(region[i].place, from, region[i].size);
        from += region[i].size;
    }
    begin_anew(past);
    return status;
}

EXPORT int fmu_derivative(void *self, const double *du, double *dy)
{
    typedef int (*Derive2)(void *, const uint32_t *, size_t, const uint32_t *, size_t, const double *, double *);
    typedef int (*Derive3)(void *, const uint32_t *, size_t, const uint32_t *, size_t, const double *, size_t, double *,
                           size_t);
    Past *past = self;
    Slave *slave = past->slave;
    const size_t n = past->n_unknowns, m = past->n_knowns;
    if (slave->failed)
        return slave->failed;
    for (size_t i = 0; i < past->n_outputs; i++)
        dy[i] = 0.0;
    for (size_t i = 0; i < m; i++)
        past->seed[i] = du[past->inputs[i].position] / past->inputs[i].factor;
    int status =
        past->version == 2
            ? ((Derive2)past->derive)(slave->instance, past->unknowns, n, past->knowns, m, past->seed, past->found)
            : ((Derive3)past->derive)(slave->instance, past->unknowns, n, past->knowns, m, past->seed, m, past->found, n);
    if (!fine(status))
        return ended(slave, status, DERIVING);
    for (size_t i = 0; i < n; i++)
        dy[past->outputs[i].position] = past->outputs[i].factor * past->found[i];
    return status;
}

/* Before the instance ends: the state kept is freed, unless a fatal forbids the call. */
EXPORT void fmu_forget(void *self)
{
    Past *past = self;
    Slave *slave = past->slave;
    if (past->state && slave->instance && slave->failed != FATAL)
        ((int (*)(void *, void **))past->free_state)(slave->instance, &past->state);
    free(past->beside);
    past->state = past->beside = NULL;
}
