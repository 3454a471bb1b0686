/* The functions of FMI 3.0, Model Exchange and Co-Simulation, over one instance. */
#include "instance.h"

#include <stdbool.h>

#if defined(_WIN32)
#define FMI_EXPORT __declspec(dllexport)
#else
#define FMI_EXPORT __attribute__((visibility("default")))
#endif

typedef void *fmi3Instance;
typedef void *fmi3InstanceEnvironment;
typedef void *fmi3FMUState;
typedef uint32_t fmi3ValueReference;
typedef float fmi3Float32;
typedef double fmi3Float64;
typedef int8_t fmi3Int8;
typedef uint8_t fmi3UInt8;
typedef int16_t fmi3Int16;
typedef uint16_t fmi3UInt16;
typedef int32_t fmi3Int32;
typedef uint32_t fmi3UInt32;
typedef int64_t fmi3Int64;
typedef uint64_t fmi3UInt64;
typedef bool fmi3Boolean;
typedef const char *fmi3String;
typedef uint8_t fmi3Byte;
typedef const fmi3Byte *fmi3Binary;
typedef bool fmi3Clock;
typedef int fmi3Status;
typedef void (*fmi3LogMessageCallback)(fmi3InstanceEnvironment, fmi3Status, fmi3String, fmi3String);
typedef void (*fmi3IntermediateUpdateCallback)(fmi3InstanceEnvironment, fmi3Float64, fmi3Boolean, fmi3Boolean,
                                               fmi3Boolean, fmi3Boolean, fmi3Boolean *, fmi3Float64 *);
typedef void (*fmi3Callback)(void);

#define ALIVE (INSTANTIATED | INITIALIZATION | STEP | EVENT | CONTINUOUS | TERMINATED | FAILED)
#define CHECK(phases, call)      \
    Instance *instance = c;      \
    if (!instance) return ERROR; \
    if (expect(instance, (phases), call)) return ERROR

static void deliver3(Instance *instance, int status, const char *category, const char *message) {
    fmi3LogMessageCallback logger = (fmi3LogMessageCallback)instance->logger;
    if (logger) logger(instance->environment, status, category, message);
}

FMI_EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

FMI_EXPORT fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t n, const fmi3String categories[]) {
    CHECK(ALIVE, "fmi3SetDebugLogging");
    (void)n, (void)categories;
    instance->logging = on;
    return OK;
}

FMI_EXPORT fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                                     fmi3Boolean visible, fmi3Boolean logging,
                                                     fmi3InstanceEnvironment environment,
                                                     fmi3LogMessageCallback logger) {
    (void)resources, (void)visible;
    return create(name, token, 0, logging, environment, (void (*)(void))logger, deliver3);
}

FMI_EXPORT fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging,
    fmi3Boolean event_mode_used, fmi3Boolean early_return_allowed, const fmi3ValueReference intermediate[], size_t n,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback logger, fmi3IntermediateUpdateCallback update) {
    Instance *instance;
    (void)resources, (void)visible, (void)intermediate, (void)n, (void)update;
    instance = create(name, token, 1, logging, environment, (void (*)(void))logger, deliver3);
    if (instance) {
        instance->event_mode_used = event_mode_used;
        instance->stop_at_events = event_mode_used && early_return_allowed;
    }
    return instance;
}

FMI_EXPORT fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources,
                                                          fmi3Boolean visible, fmi3Boolean logging,
                                                          fmi3InstanceEnvironment environment,
                                                          fmi3LogMessageCallback logger, fmi3Callback update,
                                                          fmi3Callback lock, fmi3Callback unlock) {
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)update, (void)lock, (void)unlock;
    if (logger)
        logger(environment, ERROR, "logStatusError",
               "fmi3InstantiateScheduledExecution: this FMU has Model Exchange and Co-Simulation");
    return NULL;
}

FMI_EXPORT void fmi3FreeInstance(fmi3Instance c) { destroy(c); }

FMI_EXPORT fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean tolerance_defined,
                                                  fmi3Float64 tolerance, fmi3Float64 start, fmi3Boolean stop_defined,
                                                  fmi3Float64 stop) {
    CHECK(INSTANTIATED, "fmi3EnterInitializationMode");
    (void)tolerance_defined, (void)tolerance, (void)stop_defined, (void)stop;
    instance->s.v[0] = instance->s.start_time = start;
    instance->s.phase = INITIALIZATION;
    instance->s.stale = STALE_ALL;
    return OK;
}

FMI_EXPORT fmi3Status fmi3ExitInitializationMode(fmi3Instance c) {
    CHECK(INITIALIZATION, "fmi3ExitInitializationMode");
    if (initialise(instance)) return ERROR;
    instance->s.phase = instance->co_simulation && !instance->event_mode_used ? STEP : EVENT;
    return OK;
}

FMI_EXPORT fmi3Status fmi3EnterEventMode(fmi3Instance c) {
    CHECK(CONTINUOUS | EVENT | STEP, "fmi3EnterEventMode");
    if (instance->s.phase == STEP && !instance->event_mode_used)
        return report(instance, ERROR, "logStatusError",
                      "fmi3EnterEventMode: the instance was made with eventModeUsed = false");
    instance->s.phase = EVENT;
    return OK;
}

FMI_EXPORT fmi3Status fmi3EnterStepMode(fmi3Instance c) {
    CHECK(EVENT, "fmi3EnterStepMode");
    if (!instance->co_simulation)
        return report(instance, ERROR, "logStatusError", "fmi3EnterStepMode is for Co-Simulation");
    instance->s.phase = STEP;
    return OK;
}

FMI_EXPORT fmi3Status fmi3Terminate(fmi3Instance c) {
    CHECK(STEP | EVENT | CONTINUOUS, "fmi3Terminate");
    instance->s.phase = TERMINATED;
    return OK;
}

FMI_EXPORT fmi3Status fmi3Reset(fmi3Instance c) {
    CHECK(ALIVE, "fmi3Reset");
    restore_starts(instance);
    return OK;
}

#define SIZED(n, wanted, call)                                                                           \
    if ((n) != (wanted))                                                                                 \
    return report(instance, ERROR, "logStatusError", "%s wants %lu values, got %lu", call,               \
                  (unsigned long)(wanted), (unsigned long)(n))

#define GETTER(NAME, TYPE, KIND)                                                                                   \
    FMI_EXPORT fmi3Status fmi3Get##NAME(fmi3Instance c, const fmi3ValueReference r[], size_t n, TYPE values[],     \
                                        size_t n_values) {                                                         \
        size_t i;                                                                                                  \
        CHECK(ALIVE, "fmi3Get" #NAME);                                                                             \
        SIZED(n_values, n, "fmi3Get" #NAME);                                                                       \
        for (i = 0; i < n; i++) {                                                                                  \
            if (r[i] >= NV || model_kind[r[i]] != KIND) return known(instance, r[i], KIND, "fmi3Get" #NAME);       \
            refresh(&instance->s, staleness(r[i]));                                                                \
            values[i] = (TYPE)instance->s.v[r[i]];                                                                 \
        }                                                                                                          \
        return OK;                                                                                                 \
    }

#define SETTER(NAME, TYPE, KIND)                                                                                     \
    FMI_EXPORT fmi3Status fmi3Set##NAME(fmi3Instance c, const fmi3ValueReference r[], size_t n, const TYPE values[], \
                                        size_t n_values) {                                                           \
        size_t i; int parameters = 0;                                                                                                    \
        CHECK(ALIVE, "fmi3Set" #NAME);                                                                               \
        SIZED(n_values, n, "fmi3Set" #NAME);                                                                         \
        for (i = 0; i < n; i++) {                                                                                    \
            if (known(instance, r[i], KIND, "fmi3Set" #NAME)) return ERROR;                                          \
            if (settable(instance, r[i], "fmi3Set" #NAME)) return ERROR;                                             \
            if (check_setting(instance, r[i], (double)values[i], "fmi3Set" #NAME)) return ERROR;                     \
            parameters |= r[i] >= P0 && r[i] < S0; instance->s.v[r[i]] = (double)values[i];                                                                 \
        }                                                                                                            \
        after_setting(&instance->s, parameters);                    \
        return OK;                                                                                                   \
    }

/* Types that no variable of an exported model has: an empty call is fine, any other an error. */
#define ABSENT(NAME, TYPE)                                                                                        \
    FMI_EXPORT fmi3Status fmi3Get##NAME(fmi3Instance c, const fmi3ValueReference r[], size_t n, TYPE values[],    \
                                        size_t n_values) {                                                        \
        CHECK(ALIVE, "fmi3Get" #NAME);                                                                            \
        (void)r, (void)values, (void)n_values;                                                                    \
        return n ? report(instance, ERROR, "logStatusError", "fmi3Get" #NAME ": no variable has this type") : OK; \
    }                                                                                                             \
    FMI_EXPORT fmi3Status fmi3Set##NAME(fmi3Instance c, const fmi3ValueReference r[], size_t n,                   \
                                        const TYPE values[], size_t n_values) {                                   \
        CHECK(ALIVE, "fmi3Set" #NAME);                                                                            \
        (void)r, (void)values, (void)n_values;                                                                    \
        return n ? report(instance, ERROR, "logStatusError", "fmi3Set" #NAME ": no variable has this type") : OK; \
    }

GETTER(Float64, fmi3Float64, REAL)
GETTER(Int32, fmi3Int32, INTEGER)
GETTER(Boolean, fmi3Boolean, BOOLEAN)
SETTER(Float64, fmi3Float64, REAL)
SETTER(Int32, fmi3Int32, INTEGER)
SETTER(Boolean, fmi3Boolean, BOOLEAN)
ABSENT(Float32, fmi3Float32)
ABSENT(Int8, fmi3Int8)
ABSENT(UInt8, fmi3UInt8)
ABSENT(Int16, fmi3Int16)
ABSENT(UInt16, fmi3UInt16)
ABSENT(UInt32, fmi3UInt32)
ABSENT(Int64, fmi3Int64)
ABSENT(UInt64, fmi3UInt64)
ABSENT(String, fmi3String)

/* Calls about binaries, clocks and scheduled execution, which exported models do not have. */
#define REFUSED(NAME, ARGUMENTS)                                                                              \
    FMI_EXPORT fmi3Status fmi3##NAME ARGUMENTS {                                                              \
        CHECK(ALIVE, "fmi3" #NAME);                                                                           \
        return report(instance, ERROR, "logStatusError", "fmi3" #NAME " is not supported by this FMU"); \
    }

REFUSED(GetBinary, (fmi3Instance c, const fmi3ValueReference r[], size_t n, size_t sizes[], fmi3Binary values[], size_t nv))
REFUSED(SetBinary, (fmi3Instance c, const fmi3ValueReference r[], size_t n, const size_t sizes[], const fmi3Binary values[], size_t nv))
REFUSED(GetClock, (fmi3Instance c, const fmi3ValueReference r[], size_t n, fmi3Clock values[]))
REFUSED(SetClock, (fmi3Instance c, const fmi3ValueReference r[], size_t n, const fmi3Clock values[]))
REFUSED(GetIntervalDecimal, (fmi3Instance c, const fmi3ValueReference r[], size_t n, fmi3Float64 intervals[], int qualifiers[]))
REFUSED(GetIntervalFraction, (fmi3Instance c, const fmi3ValueReference r[], size_t n, fmi3UInt64 counters[], fmi3UInt64 resolutions[], int qualifiers[]))
REFUSED(GetShiftDecimal, (fmi3Instance c, const fmi3ValueReference r[], size_t n, fmi3Float64 shifts[]))
REFUSED(GetShiftFraction, (fmi3Instance c, const fmi3ValueReference r[], size_t n, fmi3UInt64 counters[], fmi3UInt64 resolutions[]))
REFUSED(SetIntervalDecimal, (fmi3Instance c, const fmi3ValueReference r[], size_t n, const fmi3Float64 intervals[]))
REFUSED(SetIntervalFraction, (fmi3Instance c, const fmi3ValueReference r[], size_t n, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[]))
REFUSED(SetShiftDecimal, (fmi3Instance c, const fmi3ValueReference r[], size_t n, const fmi3Float64 shifts[]))
REFUSED(SetShiftFraction, (fmi3Instance c, const fmi3ValueReference r[], size_t n, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[]))
REFUSED(ActivateModelPartition, (fmi3Instance c, fmi3ValueReference clock, fmi3Float64 time))
REFUSED(EnterConfigurationMode, (fmi3Instance c))
REFUSED(ExitConfigurationMode, (fmi3Instance c))
REFUSED(GetNumberOfVariableDependencies, (fmi3Instance c, fmi3ValueReference r, size_t *n))
REFUSED(GetVariableDependencies, (fmi3Instance c, fmi3ValueReference r, size_t elements[], fmi3ValueReference independents[], size_t independent_elements[], int kinds[], size_t n))
REFUSED(GetOutputDerivatives, (fmi3Instance c, const fmi3ValueReference r[], size_t n, const fmi3Int32 orders[], fmi3Float64 values[], size_t nv))

FMI_EXPORT fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state) {
    CHECK(ALIVE, "fmi3GetFMUState");
    return get_state(instance, state);
}

FMI_EXPORT fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state) {
    CHECK(ALIVE, "fmi3SetFMUState");
    return set_state(instance, state);
}

FMI_EXPORT fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *state) {
    CHECK(ALIVE, "fmi3FreeFMUState");
    if (state) {
        free(*state);
        *state = NULL;
    }
    return OK;
}

FMI_EXPORT fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState state, size_t *size) {
    CHECK(ALIVE, "fmi3SerializedFMUStateSize");
    (void)state;
    *size = serialised_size();
    return OK;
}

FMI_EXPORT fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState state, fmi3Byte bytes[], size_t size) {
    CHECK(ALIVE, "fmi3SerializeFMUState");
    return serialise(instance, state, bytes, size);
}

FMI_EXPORT fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size,
                                              fmi3FMUState *state) {
    CHECK(ALIVE, "fmi3DeserializeFMUState");
    return deserialise(instance, bytes, size, state);
}

FMI_EXPORT fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference unknowns[],
                                                   size_t n_unknown, const fmi3ValueReference knowns[],
                                                   size_t n_known, const fmi3Float64 seed[], size_t n_seed,
                                                   fmi3Float64 sensitivity[], size_t n_sensitivity) {
    CHECK(INITIALIZATION | STEP | EVENT | CONTINUOUS | TERMINATED, "fmi3GetDirectionalDerivative");
    SIZED(n_seed, n_known, "fmi3GetDirectionalDerivative: seed");
    SIZED(n_sensitivity, n_unknown, "fmi3GetDirectionalDerivative: sensitivity");
    return directional(instance, unknowns, n_unknown, knowns, n_known, seed, sensitivity,
                       "fmi3GetDirectionalDerivative");
}

FMI_EXPORT fmi3Status fmi3GetAdjointDerivative(fmi3Instance c, const fmi3ValueReference unknowns[], size_t n_unknown,
                                               const fmi3ValueReference knowns[], size_t n_known,
                                               const fmi3Float64 seed[], size_t n_seed, fmi3Float64 sensitivity[],
                                               size_t n_sensitivity) {
    CHECK(INITIALIZATION | STEP | EVENT | CONTINUOUS | TERMINATED, "fmi3GetAdjointDerivative");
    SIZED(n_seed, n_unknown, "fmi3GetAdjointDerivative: seed");
    SIZED(n_sensitivity, n_known, "fmi3GetAdjointDerivative: sensitivity");
    return adjoint(instance, unknowns, n_unknown, knowns, n_known, seed, sensitivity, "fmi3GetAdjointDerivative");
}

FMI_EXPORT fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance c) {
    CHECK(INITIALIZATION | EVENT, "fmi3EvaluateDiscreteStates");
    return OK;
}

FMI_EXPORT fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *need_update, fmi3Boolean *terminate,
                                               fmi3Boolean *nominals_changed, fmi3Boolean *values_changed,
                                               fmi3Boolean *next_time_defined, fmi3Float64 *next_time) {
    int changed = 0;
    CHECK(EVENT, "fmi3UpdateDiscreteStates");
    while (!instance->co_simulation && sample_is_due(&instance->s, instance->s.v[0])) {
        if (take_sample(instance)) return ERROR;
        changed = 1;
    }
    if (NZ) {
        int settled = settle(&instance->s);
        if (settled < 0) return fail(instance, "chattering: the events at t = %.17g s never settle", instance->s.v[0]);
        changed |= settled;
    }
    if (instance->s.event_pending) instance->s.next_step = 0;
    instance->s.event_pending = 0;
    *need_update = false;
    *terminate = false;
    *nominals_changed = false;
    *values_changed = changed && NX;
    *next_time_defined = SAMPLED && !instance->co_simulation;
    *next_time = *next_time_defined ? next_sample_time(&instance->s) : 0.0;
    return OK;
}

/* ---- Model Exchange ---- */

FMI_EXPORT fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c) {
    CHECK(EVENT, "fmi3EnterContinuousTimeMode");
    if (instance->co_simulation)
        return report(instance, ERROR, "logStatusError", "fmi3EnterContinuousTimeMode is for Model Exchange");
    instance->s.phase = CONTINUOUS;
    return OK;
}

FMI_EXPORT fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean no_set_state,
                                                  fmi3Boolean *enter_event_mode, fmi3Boolean *terminate) {
    CHECK(CONTINUOUS, "fmi3CompletedIntegratorStep");
    (void)no_set_state;
    *enter_event_mode = false;
    *terminate = false;
    return OK;
}

FMI_EXPORT fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 time) {
    CHECK(EVENT | CONTINUOUS, "fmi3SetTime");
    instance->s.v[0] = time;
    instance->s.stale |= STALE_DX | STALE_Y | STALE_Z;
    return OK;
}

FMI_EXPORT fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t n) {
    CHECK(CONTINUOUS, "fmi3SetContinuousStates");
    SIZED(n, NX, "fmi3SetContinuousStates");
    memcpy(instance->s.v + X0, x, sizeof(double) * NX);
    instance->s.stale |= STALE_DX | STALE_Y | STALE_Z;
    return OK;
}

FMI_EXPORT fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 dx[], size_t n) {
    CHECK(INITIALIZATION | EVENT | CONTINUOUS | TERMINATED, "fmi3GetContinuousStateDerivatives");
    SIZED(n, NX, "fmi3GetContinuousStateDerivatives");
    refresh(&instance->s, STALE_M | STALE_DX);
    memcpy(dx, instance->s.v + DX0, sizeof(double) * NX);
    return OK;
}

FMI_EXPORT fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 z[], size_t n) {
    CHECK(INITIALIZATION | EVENT | CONTINUOUS | TERMINATED, "fmi3GetEventIndicators");
    SIZED(n, NZ, "fmi3GetEventIndicators");
    refresh(&instance->s, STALE_M | STALE_Z);
    memcpy(z, instance->s.v + Z0, sizeof(double) * NZ);
    return OK;
}

FMI_EXPORT fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n) {
    CHECK(INITIALIZATION | EVENT | CONTINUOUS | TERMINATED, "fmi3GetContinuousStates");
    SIZED(n, NX, "fmi3GetContinuousStates");
    memcpy(x, instance->s.v + X0, sizeof(double) * NX);
    return OK;
}

FMI_EXPORT fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 nominal[], size_t n) {
    CHECK(INSTANTIATED | INITIALIZATION | EVENT | CONTINUOUS | TERMINATED, "fmi3GetNominalsOfContinuousStates");
    SIZED(n, NX, "fmi3GetNominalsOfContinuousStates");
    memcpy(nominal, model_nominal, sizeof(double) * NX);
    return OK;
}

FMI_EXPORT fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *n) {
    CHECK(ALIVE, "fmi3GetNumberOfEventIndicators");
    *n = NZ;
    return OK;
}

FMI_EXPORT fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *n) {
    CHECK(ALIVE, "fmi3GetNumberOfContinuousStates");
    *n = NX;
    return OK;
}

/* ---- Co-Simulation ---- */

FMI_EXPORT fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean no_set_state,
                                 fmi3Boolean *event_needed, fmi3Boolean *terminate, fmi3Boolean *early_return,
                                 fmi3Float64 *last_successful_time) {
    int status, early = 0;
    CHECK(STEP, "fmi3DoStep");
    (void)no_set_state;
    if (!(h > 0)) return fail(instance, "fmi3DoStep wants a step above zero, got %.17g s", h);
    if (!(fabs(t - instance->s.v[0]) <= 1e-6 * h + 1e-12 * fabs(t)))
        return fail(instance, "fmi3DoStep wants to begin at t = %.17g s, got %.17g s", instance->s.v[0], t);
    if (instance->s.event_pending)
        return fail(instance, "fmi3DoStep: the event at t = %.17g s waits for fmi3EnterEventMode", instance->s.v[0]);
    status = advance(instance, t, h);
    early = instance->s.event_pending && instance->s.v[0] < t + h;
    *event_needed = instance->s.event_pending;
    *terminate = false;
    *early_return = early;
    *last_successful_time = instance->s.v[0];
    return status;
}
