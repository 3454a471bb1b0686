/* The functions of FMI 2.0, Model Exchange and Co-Simulation, over one instance. */
#include "instance.h"

#if defined(_WIN32)
#define FMI_EXPORT __declspec(dllexport)
#else
#define FMI_EXPORT __attribute__((visibility("default")))
#endif

typedef void *fmi2Component;
typedef unsigned int fmi2ValueReference;
typedef double fmi2Real;
typedef int fmi2Integer;
typedef int fmi2Boolean;
typedef const char *fmi2String;
typedef char fmi2Byte;
typedef int fmi2Status;
typedef void *fmi2FMUstate;
typedef void (*fmi2CallbackLogger)(void *, fmi2String, fmi2Status, fmi2String, fmi2String, ...);
typedef struct {
    fmi2CallbackLogger logger;
    void *(*allocateMemory)(size_t, size_t);
    void (*freeMemory)(void *);
    void (*stepFinished)(void *, fmi2Status);
    void *componentEnvironment;
} fmi2CallbackFunctions;
typedef struct {
    fmi2Boolean newDiscreteStatesNeeded;
    fmi2Boolean terminateSimulation;
    fmi2Boolean nominalsOfContinuousStatesChanged;
    fmi2Boolean valuesOfContinuousStatesChanged;
    fmi2Boolean nextEventTimeDefined;
    fmi2Real nextEventTime;
} fmi2EventInfo;

#define ALIVE (INSTANTIATED | INITIALIZATION | STEP | EVENT | CONTINUOUS | TERMINATED | FAILED)
#define CHECK(phases, call)                          \
    Instance *instance = c;                          \
    if (!instance) return ERROR;                     \
    if (expect(instance, (phases), call)) return ERROR

static void deliver2(Instance *instance, int status, const char *category, const char *message) {
    fmi2CallbackLogger logger = (fmi2CallbackLogger)instance->logger;
    if (logger) logger(instance->environment, instance->name, status, category, "%s", message);
}

FMI_EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
FMI_EXPORT const char *fmi2GetVersion(void) { return "2.0"; }

FMI_EXPORT fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[]) {
    CHECK(ALIVE, "fmi2SetDebugLogging");
    (void)n, (void)categories;
    instance->logging = on;
    return OK;
}

FMI_EXPORT fmi2Component fmi2Instantiate(fmi2String name, int type, fmi2String guid, fmi2String resources,
                                         const fmi2CallbackFunctions *callbacks, fmi2Boolean visible,
                                         fmi2Boolean logging) {
    (void)resources, (void)visible;
    return create(name, guid, type == 1, logging, callbacks ? callbacks->componentEnvironment : NULL,
                  callbacks ? (void (*)(void))callbacks->logger : NULL, deliver2);
}

FMI_EXPORT void fmi2FreeInstance(fmi2Component c) { destroy(c); }

FMI_EXPORT fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean tolerance_defined, fmi2Real tolerance,
                                          fmi2Real start, fmi2Boolean stop_defined, fmi2Real stop) {
    CHECK(INSTANTIATED, "fmi2SetupExperiment");
    (void)tolerance_defined, (void)tolerance, (void)stop_defined, (void)stop;
    instance->s.v[0] = instance->s.start_time = start;
    return OK;
}

FMI_EXPORT fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
    CHECK(INSTANTIATED, "fmi2EnterInitializationMode");
    instance->s.phase = INITIALIZATION;
    instance->s.stale = STALE_ALL;
    return OK;
}

FMI_EXPORT fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    CHECK(INITIALIZATION, "fmi2ExitInitializationMode");
    if (initialise(instance)) return ERROR;
    instance->s.phase = instance->co_simulation ? STEP : EVENT;
    return OK;
}

FMI_EXPORT fmi2Status fmi2Terminate(fmi2Component c) {
    CHECK(STEP | EVENT | CONTINUOUS, "fmi2Terminate");
    instance->s.phase = TERMINATED;
    return OK;
}

FMI_EXPORT fmi2Status fmi2Reset(fmi2Component c) {
    CHECK(ALIVE, "fmi2Reset");
    restore_starts(instance);
    return OK;
}

#define GETTER(NAME, TYPE, KIND)                                                                                  \
    FMI_EXPORT fmi2Status fmi2Get##NAME(fmi2Component c, const fmi2ValueReference r[], size_t n, TYPE values[]) { \
        size_t i;                                                                                                 \
        CHECK(ALIVE, "fmi2Get" #NAME);                                                                            \
        for (i = 0; i < n; i++) {                                                                                 \
            if (r[i] >= NV || model_kind[r[i]] != KIND) return known(instance, r[i], KIND, "fmi2Get" #NAME);      \
            refresh(&instance->s, staleness(r[i]));                                                               \
            values[i] = (TYPE)instance->s.v[r[i]];                                                                \
        }                                                                                                         \
        return OK;                                                                                                \
    }

#define SETTER(NAME, TYPE, KIND)                                                                                        \
    FMI_EXPORT fmi2Status fmi2Set##NAME(fmi2Component c, const fmi2ValueReference r[], size_t n, const TYPE values[]) { \
        size_t i; int parameters = 0;                                                                                                       \
        CHECK(ALIVE, "fmi2Set" #NAME);                                                                                  \
        for (i = 0; i < n; i++) {                                                                                       \
            if (known(instance, r[i], KIND, "fmi2Set" #NAME)) return ERROR;                                             \
            if (settable(instance, r[i], "fmi2Set" #NAME)) return ERROR;                                                \
            if (check_setting(instance, r[i], (double)values[i], "fmi2Set" #NAME)) return ERROR;                        \
            parameters |= r[i] >= P0 && r[i] < S0; instance->s.v[r[i]] = (double)values[i];                                                                    \
        }                                                                                                               \
        after_setting(&instance->s, parameters);                    \
        return OK;                                                                                                      \
    }

GETTER(Real, fmi2Real, REAL)
GETTER(Integer, fmi2Integer, INTEGER)
GETTER(Boolean, fmi2Boolean, BOOLEAN)
SETTER(Real, fmi2Real, REAL)
SETTER(Integer, fmi2Integer, INTEGER)
SETTER(Boolean, fmi2Boolean, BOOLEAN)

FMI_EXPORT fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2String values[]) {
    CHECK(ALIVE, "fmi2GetString");
    (void)r, (void)values;
    return n ? report(instance, ERROR, "logStatusError", "fmi2GetString: this model has no strings") : OK;
}

FMI_EXPORT fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference r[], size_t n,
                                    const fmi2String values[]) {
    CHECK(ALIVE, "fmi2SetString");
    (void)r, (void)values;
    return n ? report(instance, ERROR, "logStatusError", "fmi2SetString: this model has no strings") : OK;
}

FMI_EXPORT fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) {
    CHECK(ALIVE, "fmi2GetFMUstate");
    return get_state(instance, state);
}

FMI_EXPORT fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) {
    CHECK(ALIVE, "fmi2SetFMUstate");
    return set_state(instance, state);
}

FMI_EXPORT fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state) {
    CHECK(ALIVE, "fmi2FreeFMUstate");
    if (state) {
        free(*state);
        *state = NULL;
    }
    return OK;
}

FMI_EXPORT fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size) {
    CHECK(ALIVE, "fmi2SerializedFMUstateSize");
    (void)state;
    *size = serialised_size();
    return OK;
}

FMI_EXPORT fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size) {
    CHECK(ALIVE, "fmi2SerializeFMUstate");
    return serialise(instance, state, bytes, size);
}

FMI_EXPORT fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size,
                                              fmi2FMUstate *state) {
    CHECK(ALIVE, "fmi2DeSerializeFMUstate");
    return deserialise(instance, bytes, size, state);
}

FMI_EXPORT fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknowns[],
                                                   size_t n_unknown, const fmi2ValueReference knowns[],
                                                   size_t n_known, const fmi2Real seed[], fmi2Real sensitivity[]) {
    CHECK(INITIALIZATION | STEP | EVENT | CONTINUOUS | TERMINATED, "fmi2GetDirectionalDerivative");
    return directional(instance, unknowns, n_unknown, knowns, n_known, seed, sensitivity,
                       "fmi2GetDirectionalDerivative");
}

/* ---- Model Exchange ---- */

FMI_EXPORT fmi2Status fmi2EnterEventMode(fmi2Component c) {
    CHECK(CONTINUOUS | EVENT, "fmi2EnterEventMode");
    instance->s.phase = EVENT;
    return OK;
}

FMI_EXPORT fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info) {
    int changed = 0;
    CHECK(EVENT, "fmi2NewDiscreteStates");
    while (sample_is_due(&instance->s, instance->s.v[0])) {
        if (take_sample(instance)) return ERROR;
        changed = 1;
    }
    if (NZ) {
        int settled = settle(&instance->s);
        if (settled < 0) return fail(instance, "chattering: the events at t = %.17g s never settle", instance->s.v[0]);
        changed |= settled;
    }
    info->newDiscreteStatesNeeded = 0;
    info->terminateSimulation = 0;
    info->nominalsOfContinuousStatesChanged = 0;
    info->valuesOfContinuousStatesChanged = changed && NX;
    info->nextEventTimeDefined = SAMPLED;
    info->nextEventTime = next_sample_time(&instance->s);
    return OK;
}

FMI_EXPORT fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) {
    CHECK(EVENT, "fmi2EnterContinuousTimeMode");
    instance->s.phase = CONTINUOUS;
    return OK;
}

FMI_EXPORT fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean no_set_state,
                                                  fmi2Boolean *enter_event_mode, fmi2Boolean *terminate) {
    CHECK(CONTINUOUS, "fmi2CompletedIntegratorStep");
    (void)no_set_state;
    *enter_event_mode = 0;
    *terminate = 0;
    return OK;
}

FMI_EXPORT fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time) {
    CHECK(EVENT | CONTINUOUS, "fmi2SetTime");
    instance->s.v[0] = time;
    instance->s.stale |= STALE_DX | STALE_Y | STALE_Z;
    return OK;
}

#define SIZED(n, wanted, call)                                                                                    \
    if ((n) != (wanted))                                                                                          \
    return report(instance, ERROR, "logStatusError", "%s wants %d values, got %lu", call, (int)(wanted), \
                  (unsigned long)(n))

FMI_EXPORT fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t n) {
    CHECK(CONTINUOUS, "fmi2SetContinuousStates");
    SIZED(n, NX, "fmi2SetContinuousStates");
    memcpy(instance->s.v + X0, x, sizeof(double) * NX);
    instance->s.stale |= STALE_DX | STALE_Y | STALE_Z;
    return OK;
}

FMI_EXPORT fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real dx[], size_t n) {
    CHECK(INITIALIZATION | EVENT | CONTINUOUS | TERMINATED, "fmi2GetDerivatives");
    SIZED(n, NX, "fmi2GetDerivatives");
    refresh(&instance->s, STALE_M | STALE_DX);
    memcpy(dx, instance->s.v + DX0, sizeof(double) * NX);
    return OK;
}

FMI_EXPORT fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real z[], size_t n) {
    CHECK(INITIALIZATION | EVENT | CONTINUOUS | TERMINATED, "fmi2GetEventIndicators");
    SIZED(n, NZ, "fmi2GetEventIndicators");
    refresh(&instance->s, STALE_M | STALE_Z);
    memcpy(z, instance->s.v + Z0, sizeof(double) * NZ);
    return OK;
}

FMI_EXPORT fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t n) {
    CHECK(INITIALIZATION | EVENT | CONTINUOUS | TERMINATED, "fmi2GetContinuousStates");
    SIZED(n, NX, "fmi2GetContinuousStates");
    memcpy(x, instance->s.v + X0, sizeof(double) * NX);
    return OK;
}

FMI_EXPORT fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real nominal[], size_t n) {
    CHECK(INSTANTIATED | INITIALIZATION | EVENT | CONTINUOUS | TERMINATED, "fmi2GetNominalsOfContinuousStates");
    SIZED(n, NX, "fmi2GetNominalsOfContinuousStates");
    memcpy(nominal, model_nominal, sizeof(double) * NX);
    return OK;
}

/* ---- Co-Simulation ---- */

FMI_EXPORT fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference r[], size_t n,
                                                  const fmi2Integer order[], const fmi2Real values[]) {
    CHECK(ALIVE, "fmi2SetRealInputDerivatives");
    (void)r, (void)n, (void)order, (void)values;
    return report(instance, ERROR, "logStatusError", "fmi2SetRealInputDerivatives: inputs are not interpolated");
}

FMI_EXPORT fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference r[], size_t n,
                                                   const fmi2Integer order[], fmi2Real values[]) {
    CHECK(ALIVE, "fmi2GetRealOutputDerivatives");
    (void)r, (void)n, (void)order, (void)values;
    return report(instance, ERROR, "logStatusError", "fmi2GetRealOutputDerivatives: there are none");
}

FMI_EXPORT fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no_set_state) {
    CHECK(STEP, "fmi2DoStep");
    (void)no_set_state;
    if (!(h > 0)) return fail(instance, "fmi2DoStep wants a step above zero, got %.17g s", h);
    if (!(fabs(t - instance->s.v[0]) <= 1e-6 * h + 1e-12 * fabs(t)))
        return fail(instance, "fmi2DoStep wants to begin at t = %.17g s, got %.17g s", instance->s.v[0], t);
    return advance(instance, t, h);
}

FMI_EXPORT fmi2Status fmi2CancelStep(fmi2Component c) {
    CHECK(ALIVE, "fmi2CancelStep");
    return report(instance, ERROR, "logStatusError", "fmi2CancelStep: no step is pending");
}

FMI_EXPORT fmi2Status fmi2GetStatus(fmi2Component c, int kind, fmi2Status *value) {
    CHECK(ALIVE, "fmi2GetStatus");
    (void)kind, (void)value;
    return report(instance, DISCARD, "logStatusDiscard", "fmi2GetStatus: no step is pending");
}

FMI_EXPORT fmi2Status fmi2GetRealStatus(fmi2Component c, int kind, fmi2Real *value) {
    CHECK(ALIVE, "fmi2GetRealStatus");
    if (kind != 2) return report(instance, DISCARD, "logStatusDiscard", "fmi2GetRealStatus: unknown kind %d", kind);
    *value = instance->last_successful_time;
    return OK;
}

FMI_EXPORT fmi2Status fmi2GetIntegerStatus(fmi2Component c, int kind, fmi2Integer *value) {
    CHECK(ALIVE, "fmi2GetIntegerStatus");
    (void)kind, (void)value;
    return report(instance, DISCARD, "logStatusDiscard", "fmi2GetIntegerStatus: there is none");
}

FMI_EXPORT fmi2Status fmi2GetBooleanStatus(fmi2Component c, int kind, fmi2Boolean *value) {
    CHECK(ALIVE, "fmi2GetBooleanStatus");
    if (kind != 3)
        return report(instance, DISCARD, "logStatusDiscard", "fmi2GetBooleanStatus: unknown kind %d", kind);
    *value = 0;
    return OK;
}

FMI_EXPORT fmi2Status fmi2GetStringStatus(fmi2Component c, int kind, fmi2String *value) {
    CHECK(ALIVE, "fmi2GetStringStatus");
    (void)kind, (void)value;
    return report(instance, DISCARD, "logStatusDiscard", "fmi2GetStringStatus: no step is pending");
}
