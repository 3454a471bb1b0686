/* One instance's life: messages, call-sequence checks, values, events, and its state as bytes. */
#include "instance.h"

static int report(Instance *instance, int status, const char *category, const char *format, ...) {
    char message[1024];
    va_list arguments;
    if (status < DISCARD && !instance->logging) return status;
    va_start(arguments, format);
    vsnprintf(message, sizeof message, format, arguments);
    va_end(arguments);
    if (instance->deliver) instance->deliver(instance, status, category, message);
    return status;
}

static int fail(Instance *instance, const char *format, ...) {
    char message[960];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(message, sizeof message, format, arguments);
    va_end(arguments);
    instance->s.phase = FAILED;
    return report(instance, ERROR, "logStatusError", "%s", message);
}

static const char *phase_name(int phase) {
    switch (phase) {
        case INSTANTIATED: return "instantiated";
        case INITIALIZATION: return "initialization mode";
        case STEP: return "step mode";
        case EVENT: return "event mode";
        case CONTINUOUS: return "continuous-time mode";
        case TERMINATED: return "terminated";
        default: return "error";
    }
}

/* OK where the call may come now; else an error that names the call and the state. */
static int expect(Instance *instance, int phases, const char *call) {
    if (instance->s.phase & phases) return OK;
    return report(instance, ERROR, "logStatusError", "%s may not be called in the state '%s'", call,
                  phase_name(instance->s.phase));
}

static void restore_starts(Instance *instance) {
    memset(&instance->s, 0, sizeof instance->s);
    memcpy(instance->s.v, model_start, sizeof(double) * NV);
    model_constants(instance->s.v + P0, instance->s.c);
    instance->s.phase = INSTANTIATED;
    instance->s.stale = STALE_ALL;
}

static Instance *create(const char *name, const char *token, int co_simulation, int logging, void *environment,
                        void (*logger)(void),
                        void (*deliver)(struct Instance *, int, const char *, const char *)) {
    Instance *instance = calloc(1, sizeof *instance);
    if (!instance) return NULL;
    instance->name = calloc(1, strlen(name ? name : "") + 1);
    if (!instance->name) {
        free(instance);
        return NULL;
    }
    strcpy(instance->name, name ? name : "");
    instance->co_simulation = co_simulation;
    instance->logging = logging;
    instance->environment = environment;
    instance->logger = logger;
    instance->deliver = deliver;
    restore_starts(instance);
    if (!token || strcmp(token, MODEL_TOKEN) != 0) {
        report(instance, ERROR, "logStatusError", "wants the instantiation token %s, got %s", MODEL_TOKEN,
               token ? token : "none");
        free(instance->name);
        free(instance);
        return NULL;
    }
    return instance;
}

static void destroy(Instance *instance) {
    if (!instance) return;
    free(instance->name);
    free(instance);
}

/* ---- values ---- */

#define ARGUMENTS(s) (s)->v[0], (s)->v + X0, (s)->v + M0, (s)->v + U0, (s)->v + P0, (s)->c

static void look_at_signs(State *s, const double *old_above, double *above) {
    /* Within a nanosecond of the zero the direction decides, not the rounding of z. */
    double z[NZ + 1], rate[NZ + 1];
    int i;
    model_indicators(ARGUMENTS(s), z);
    model_indicator_rates(ARGUMENTS(s), rate);
    for (i = 0; i < NZ; i++) {
        if (fabs(z[i]) <= 1e-9 * fabs(rate[i]))
            above[i] = rate[i] > 0;
        else if (z[i] == 0)
            above[i] = old_above ? old_above[i] : 1;
        else
            above[i] = z[i] > 0;
    }
}

/* The discrete states that the signs at initialisation give, without changing the continuous ones. */
static void initial_discrete(State *s) {
    double above[NZ + 1], x[NX + 1], m[NM + 1];
    look_at_signs(s, NULL, above);
    model_transition(ARGUMENTS(s), above, x, m);
    memcpy(s->v + M0, m, sizeof(double) * NM);
}

static void refresh(State *s, int what) {
    what &= s->stale;
    if (!what) return;
    if (what & STALE_M) {
        if (s->phase == INITIALIZATION && NZ) initial_discrete(s);
        s->stale &= ~STALE_M;
    }
    if (what & STALE_DX) model_derivatives(ARGUMENTS(s), s->v + DX0);
    if (what & STALE_Y) model_outputs(ARGUMENTS(s), s->v + Y0);
    if (what & STALE_Z) model_indicators(ARGUMENTS(s), s->v + Z0);
    s->stale &= ~what;
}

static int staleness(size_t reference) {
    if (reference >= DX0 && reference < U0) return STALE_M | STALE_DX;
    if (reference >= Y0 && reference < Z0) return STALE_M | STALE_Y;
    if (reference >= Z0 && reference < M0) return STALE_M | STALE_Z;
    if (reference >= M0 && reference < P0) return STALE_M;
    return 0;
}

static int known(Instance *instance, size_t reference, int kind, const char *call) {
    static const char *const kinds[] = {"real", "integer", "boolean"};
    if (reference >= NV)
        return report(instance, ERROR, "logStatusError", "%s: no variable has the value reference %lu", call,
                      (unsigned long)reference);
    if (model_kind[reference] != kind)
        return report(instance, ERROR, "logStatusError", "%s: '%s' is of type %s", call, model_name[reference],
                      kinds[model_kind[reference]]);
    return OK;
}

/* What follows from new values. */
static void after_setting(State *s, int parameters_changed) {
    if (parameters_changed) model_constants(s->v + P0, s->c);
    s->stale |= STALE_ALL;
}

static int settable(Instance *instance, size_t reference, const char *call) {
    if (model_settable[reference] & instance->s.phase) return OK;
    return report(instance, ERROR, "logStatusError", "%s: '%s' may not be set in the state '%s'", call,
                  model_name[reference], phase_name(instance->s.phase));
}

static int check_setting(Instance *instance, size_t reference, double value, const char *call) {
    if (NS && reference == METHOD && value != RK4 && value != RODAS4)
        return report(instance, ERROR, "logStatusError", "%s: '%s' wants 1 (RK4) or 2 (RODAS4), got %g", call,
                      model_name[reference], value);
    if (NS && reference == STEP_SIZE && !(value > 0))
        return report(instance, ERROR, "logStatusError", "%s: '%s' wants a step above zero, got %g", call,
                      model_name[reference], value);
    return OK;
}

/* ---- events ---- */

enum { MAX_EVENT_ITERATIONS = 100 };

/* Transitions until nothing changes. Returns 1 where anything did, 0 where not, -1 where it never ends. */
static int settle(State *s) {
    int iteration, changed_at_all = 0;
    for (iteration = 0; iteration < MAX_EVENT_ITERATIONS; iteration++) {
        double above[NZ + 1], x[NX + 1], m[NM + 1];
        int changed;
        look_at_signs(s, s->above, above);
        model_transition(ARGUMENTS(s), above, x, m);
        changed = memcmp(above, s->above, sizeof(double) * NZ) != 0 ||
                  memcmp(x, s->v + X0, sizeof(double) * NX) != 0 || memcmp(m, s->v + M0, sizeof(double) * NM) != 0;
        memcpy(s->above, above, sizeof(double) * NZ);
        memcpy(s->v + X0, x, sizeof(double) * NX);
        memcpy(s->v + M0, m, sizeof(double) * NM);
        if (!changed) return changed_at_all;
        changed_at_all = 1;
        s->stale |= STALE_ALL;
    }
    return -1;
}

static int take_sample(Instance *instance) {
    State *s = &instance->s;
    double x[NX + 1], m[NM + 1];
#if KERNEL
    int status = kernel_sample(instance, x, m);
    if (status != OK) return status;
#else
    model_sample(ARGUMENTS(s), x, m);
#endif
    memcpy(s->v + X0, x, sizeof(double) * NX);
    memcpy(s->v + M0, m, sizeof(double) * NM);
    s->sample_count += 1;
    s->stale |= STALE_ALL;
    return OK;
}

/* A sample time of 0 stands for each communication step. */
static int samples_each_step(const State *s) {
#if SAMPLED
    return s->v[SAMPLE_TIME] == 0.0;
#else
    (void)s;
    return 0;
#endif
}

static double next_sample_time(const State *s) {
#if SAMPLED
    if (samples_each_step(s)) return INFINITY;
    return s->start_time + (double)(s->sample_count + 1) * s->v[SAMPLE_TIME];
#else
    (void)s;
    return INFINITY;
#endif
}

static int sample_is_due(const State *s, double t) {
#if SAMPLED
    return next_sample_time(s) <= t + 1e-6 * s->v[SAMPLE_TIME];
#else
    (void)s, (void)t;
    return 0;
#endif
}

static int initialise(Instance *instance) {
    State *s = &instance->s;
    if (NS && !(s->v[STEP_SIZE] > 0)) return fail(instance, "%s must be above zero", model_name[STEP_SIZE]);
#if SAMPLED
    if (!(s->v[SAMPLE_TIME] >= 0)) return fail(instance, "%s must not be below zero", model_name[SAMPLE_TIME]);
    if (samples_each_step(s) && !instance->co_simulation)
        return fail(instance, "%s is zero, which stands for each communication step: Model Exchange has none",
                    model_name[SAMPLE_TIME]);
#endif
    s->stale = STALE_ALL;
    if (NZ) {
        double x[NX + 1], m[NM + 1];
        look_at_signs(s, NULL, s->above);
        model_transition(ARGUMENTS(s), s->above, x, m);
        memcpy(s->v + X0, x, sizeof(double) * NX);
        memcpy(s->v + M0, m, sizeof(double) * NM);
        if (settle(s) < 0) return fail(instance, "the events at initialisation never settle");
    }
    s->stale = STALE_ALL & ~STALE_M;
    return OK;
}

/* ---- state as bytes ---- */

typedef struct {
    char magic[8];
    uint64_t model;
    uint64_t size;
} Header;

static uint64_t model_hash(void) {
    const char *c;
    uint64_t hash = 1469598103934665603u;
    for (c = MODEL_TOKEN; *c; c++) hash = (hash ^ (unsigned char)*c) * 1099511628211u;
    return hash;
}

static Header header(void) {
    Header h;
    memset(&h, 0, sizeof h);
    memcpy(h.magic, "CRKBNCH1", 8);
    h.model = model_hash();
    h.size = sizeof(State);
    return h;
}

static int get_state(Instance *instance, void **state) {
    if (!*state) *state = malloc(sizeof(State));
    if (!*state) return report(instance, ERROR, "logStatusError", "no memory for the FMU state");
    memcpy(*state, &instance->s, sizeof(State));
    return OK;
}

static int set_state(Instance *instance, const void *state) {
    if (!state) return report(instance, ERROR, "logStatusError", "wants an FMU state, got a null pointer");
    memcpy(&instance->s, state, sizeof(State));
    return OK;
}

static size_t serialised_size(void) { return sizeof(Header) + sizeof(State); }

static int serialise(Instance *instance, const void *state, void *bytes, size_t size) {
    Header h = header();
    if (!state || size < serialised_size())
        return report(instance, ERROR, "logStatusError", "the FMU state wants %lu bytes, got %lu",
                      (unsigned long)serialised_size(), (unsigned long)size);
    memcpy(bytes, &h, sizeof h);
    memcpy((char *)bytes + sizeof h, state, sizeof(State));
    return OK;
}

static int deserialise(Instance *instance, const void *bytes, size_t size, void **state) {
    Header wanted = header();
    if (size < serialised_size() || memcmp(bytes, &wanted, sizeof wanted) != 0)
        return report(instance, ERROR, "logStatusError",
                      "these %lu bytes are not a state of this model and version", (unsigned long)size);
    if (!*state) *state = malloc(sizeof(State));
    if (!*state) return report(instance, ERROR, "logStatusError", "no memory for the FMU state");
    memcpy(*state, (const char *)bytes + sizeof wanted, sizeof(State));
    return OK;
}

/* ---- directional derivatives ---- */

static int seed_position(Instance *instance, size_t reference, double *sx, double *su, double *sp, double **seed,
                         const char *call) {
    if (reference >= X0 && reference < X0 + NX)
        *seed = sx + (reference - X0);
    else if (reference >= U0 && reference < U0 + NU)
        *seed = su + (reference - U0);
    else if (reference >= P0 && reference < P0 + NP)
        *seed = sp + (reference - P0);
    else
        return report(instance, ERROR, "logStatusError",
                      "%s: no derivative with respect to '%s'; known are states, inputs and parameters", call,
                      reference < NV ? model_name[reference] : "an unknown value reference");
    return OK;
}

static int result_position(Instance *instance, size_t reference, double *sx, double *sdx, double *sy,
                           double **result, const char *call) {
    if (reference >= X0 && reference < X0 + NX)
        *result = sx + (reference - X0);
    else if (reference >= DX0 && reference < DX0 + NX)
        *result = sdx + (reference - DX0);
    else if (reference >= Y0 && reference < Y0 + NY)
        *result = sy + (reference - Y0);
    else
        return report(instance, ERROR, "logStatusError",
                      "%s: no derivative of '%s'; known are states, their derivatives and outputs", call,
                      reference < NV ? model_name[reference] : "an unknown value reference");
    return OK;
}

/* sensitivity = (d unknown / d known) seed */
static int directional(Instance *instance, const uint32_t *unknown, size_t n_unknown, const uint32_t *knowns,
                       size_t n_known, const double *seed, double *sensitivity, const char *call) {
    State *s = &instance->s;
    double sx[NX + 1] = {0}, su[NU + 1] = {0}, sp[NP + 1] = {0}, sdx[NX + 1] = {0}, sy[NY + 1] = {0}, *place = NULL;
    size_t i;
    refresh(s, STALE_M);
    for (i = 0; i < n_known; i++) {
        if (seed_position(instance, knowns[i], sx, su, sp, &place, call)) return ERROR;
        *place += seed[i];
    }
    model_forward(ARGUMENTS(s), sx, su, sp, sdx, sy);
    for (i = 0; i < n_unknown; i++) {
        if (result_position(instance, unknown[i], sx, sdx, sy, &place, call)) return ERROR;
        sensitivity[i] = *place;
    }
    return OK;
}

/* sensitivity = (d unknown / d known)' seed */
static inline int adjoint(Instance *instance, const uint32_t *unknown, size_t n_unknown, const uint32_t *knowns,
                   size_t n_known, const double *seed, double *sensitivity, const char *call) {
    State *s = &instance->s;
    double lx[NX + 1] = {0}, lu[NU + 1] = {0}, lp[NP + 1] = {0}, direct[NX + 1] = {0}, ldx[NX + 1] = {0},
           ly[NY + 1] = {0}, *place = NULL;
    size_t i;
    refresh(s, STALE_M);
    for (i = 0; i < n_unknown; i++) {
        if (result_position(instance, unknown[i], direct, ldx, ly, &place, call)) return ERROR;
        *place += seed[i];
    }
    model_reverse(ARGUMENTS(s), ldx, ly, lx, lu, lp);
    for (i = 0; i < NX; i++) lx[i] += direct[i];
    for (i = 0; i < n_known; i++) {
        if (seed_position(instance, knowns[i], lx, lu, lp, &place, call)) return ERROR;
        sensitivity[i] = *place;
    }
    return OK;
}
