/* An FMI 2.0 Co-Simulation FMU of x' = u - x, y = x^2 + u that does not do what it declares, in one way: FAULT. */

#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

enum { NONE, CRASHES_WHEN_WRITTEN, HANGS_IN_RESET, FORGETS_WHEN_TAKEN_BACK, DERIVES_WRONGLY, TAKES_ONE_STEP_LENGTH,
       SHARES_ITS_STATE, NEVER_TWICE_THE_SAME, NOT_A_NUMBER, KEEPS_ITS_STATE_IN_RESET, WRITES_AN_ADDRESS,
       IGNORES_THE_STEP_LENGTH, HANGS_IN_INSTANTIATE, EXITS_IN_STEP, CANNOT_BE_KEPT, LENDS_WHAT_IT_KEEPS,
       BELIEVES_WHAT_IT_IS_TOLD };

typedef struct {
    double x, u, time, drift;
    long steps;
    int final; /* it was told that it is not taken back any more */
} State;

/* States that are kept now, by all instances. */
EXPORT long states_kept;

static State shared;
static long runs;

#define X (FAULT == SHARES_ITS_STATE ? &shared : (State *)c)
enum { OK = 0, ERROR = 3 };

EXPORT const char *fmi2GetVersion(void) { return "2.0"; }
EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT int fmi2SetDebugLogging(void *c, int on, size_t n, const char *const names[]) { return OK; }

EXPORT void *fmi2Instantiate(const char *name, int type, const char *guid, const char *place, const void *callbacks,
                             int visible, int on)
{
    if (FAULT == HANGS_IN_INSTANTIATE)
        for (;;) usleep(1000);
    State *made = calloc(1, sizeof(State));
    made->x = 1.0;
    shared = *made;
    runs += 1;
    return made;
}
EXPORT void fmi2FreeInstance(void *c) { free(c); }
EXPORT int fmi2SetupExperiment(void *c, int t, double tolerance, double start, int s, double stop) { return OK; }
EXPORT int fmi2EnterInitializationMode(void *c) { return OK; }
EXPORT int fmi2ExitInitializationMode(void *c) { return OK; }
EXPORT int fmi2Terminate(void *c) { return OK; }
EXPORT int fmi2Reset(void *c)
{
    if (FAULT == HANGS_IN_RESET)
        for (;;) usleep(1000);
    double kept = X->drift + (FAULT == KEEPS_ITS_STATE_IN_RESET ? 1.0 : 0.0);
    memset(X, 0, sizeof(State));
    X->x = 1.0;
    X->drift = FAULT == KEEPS_ITS_STATE_IN_RESET ? kept : 0.0;
    return OK;
}

EXPORT int fmi2GetReal(void *c, const unsigned r[], size_t n, double v[])
{
    for (size_t i = 0; i < n; i++) {
        double x = X->x, u = X->u;
        v[i] = r[i] == 0 ? u : r[i] == 1 ? x : r[i] == 2 ? u - x : x * x + u + X->drift;
        if (FAULT == NOT_A_NUMBER && r[i] == 3 && X->steps > 3) v[i] = NAN;
        if (FAULT == NEVER_TWICE_THE_SAME && r[i] == 3) v[i] += 1e-9 * (double)runs;
    }
    return OK;
}
EXPORT int fmi2SetReal(void *c, const unsigned r[], size_t n, const double v[])
{
    for (size_t i = 0; i < n; i++) {
        if (r[i] == 0) X->u = v[i];
        if (r[i] == 1) X->x = v[i];
    }
    return OK;
}
#define NO_VALUES(type, c_type)                                                                                      \
    EXPORT int fmi2Get##type(void *c, const unsigned r[], size_t n, c_type v[]) { return n ? ERROR : OK; }           \
    EXPORT int fmi2Set##type(void *c, const unsigned r[], size_t n, const c_type v[]) { return n ? ERROR : OK; }
NO_VALUES(Integer, int)
NO_VALUES(Boolean, int)
NO_VALUES(String, char *)

EXPORT int fmi2GetFMUstate(void *c, void **kept)
{
    if (FAULT == CANNOT_BE_KEPT) return ERROR;
    if (!*kept) {
        *kept = malloc(sizeof(State));
        states_kept++;
    }
    memcpy(*kept, X, sizeof(State));
    return OK;
}
EXPORT int fmi2SetFMUstate(void *c, void *kept)
{
    double drift = X->drift;
    if (FAULT == BELIEVES_WHAT_IT_IS_TOLD && X->final) return ERROR;
    memcpy(X, kept, sizeof(State));
    if (FAULT == LENDS_WHAT_IT_KEEPS) ((State *)kept)->drift += 0.5;
    if (FAULT == FORGETS_WHEN_TAKEN_BACK) X->drift = drift + 0.5;
    return OK;
}
EXPORT int fmi2FreeFMUstate(void *c, void **kept)
{
    if (*kept) states_kept--;
    free(*kept);
    *kept = NULL;
    return OK;
}
EXPORT int fmi2SerializedFMUstateSize(void *c, void *kept, size_t *size)
{
    *size = FAULT == WRITES_AN_ADDRESS ? sizeof(void *) : sizeof(State);
    return OK;
}
EXPORT int fmi2SerializeFMUstate(void *c, void *kept, char bytes[], size_t size)
{
    if (FAULT == CRASHES_WHEN_WRITTEN) *(volatile int *)0 = 1;
    if (FAULT == WRITES_AN_ADDRESS) {
        State *copy = malloc(sizeof(State));
        memcpy(copy, kept, sizeof(State));
        memcpy(bytes, &copy, sizeof(void *));
    } else {
        memcpy(bytes, kept, size);
    }
    return OK;
}
EXPORT int fmi2DeSerializeFMUstate(void *c, const char bytes[], size_t size, void **kept)
{
    const void *from = bytes;
    if (FAULT == WRITES_AN_ADDRESS) memcpy(&from, bytes, sizeof(void *));
    if (!*kept) {
        *kept = malloc(sizeof(State));
        states_kept++;
    }
    memcpy(*kept, from, sizeof(State));
    return OK;
}

EXPORT int fmi2GetDirectionalDerivative(void *c, const unsigned unknown[], size_t n, const unsigned known[], size_t m,
                                        const double seed[], double out[])
{
    double dx = 0.0, du = 0.0;
    for (size_t i = 0; i < m; i++) *(known[i] == 0 ? &du : &dx) += seed[i];
    for (size_t i = 0; i < n; i++) out[i] = unknown[i] == 2 ? du - dx : 2.0 * X->x * dx + du;
    if (FAULT == DERIVES_WRONGLY)
        for (size_t i = 0; i < n; i++) out[i] *= 1.01;
    return OK;
}

EXPORT int fmi2DoStep(void *c, double t, double h, int final)
{
    if (FAULT == EXITS_IN_STEP && X->steps == 3) exit(0);
    if (FAULT == TAKES_ONE_STEP_LENGTH && fabs(h - 0.1) > 1e-12) return ERROR;
    if (FAULT == IGNORES_THE_STEP_LENGTH) h = 0.1;
    if (final) X->final = 1;
    X->x = X->u + (X->x - X->u) * exp(-h);
    X->time = t + h;
    X->steps += 1;
    return OK;
}
EXPORT int fmi2CancelStep(void *c) { return ERROR; }
EXPORT int fmi2GetStatus(void *c, int kind, int *v) { return ERROR; }
EXPORT int fmi2GetRealStatus(void *c, int kind, double *v) { return ERROR; }
EXPORT int fmi2GetIntegerStatus(void *c, int kind, int *v) { return ERROR; }
EXPORT int fmi2GetBooleanStatus(void *c, int kind, int *v) { return ERROR; }
EXPORT int fmi2GetStringStatus(void *c, int kind, const char **v) { return ERROR; }
EXPORT int fmi2SetRealInputDerivatives(void *c, const unsigned r[], size_t n, const int o[], const double v[]) { return ERROR; }
EXPORT int fmi2GetRealOutputDerivatives(void *c, const unsigned r[], size_t n, const int o[], double v[]) { return ERROR; }
