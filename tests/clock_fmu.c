/* An FMI 3.0 FMU of both kinds with a clock that ticks from outside. It counts its ticks and notes the time of the last,
 * integrates its input, and in Co-Simulation returns early where the integral passes 1, for an event. */
#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#if defined(_WIN32)
#define API __declspec(dllexport)
#else
#define API __attribute__((visibility("default")))
#endif
enum { OK, WARNING, DISCARD, ERROR, FATAL };
enum { TIME, U, X, TICKS, LAST_TICK, PASSED, EVENTS, DX, CLOCK, STUCK, SAMPLES };
typedef struct { double v[16]; int64_t samples; bool uses_events, active, passed, in_event_mode; } Instance;
#define THIS Instance *m = i
API const char *fmi3GetVersion(void) { return "3.0"; }
API void *fmi3InstantiateCoSimulation(const char *n, const char *t, const char *r, bool v, bool l, bool events, bool early,
                                      const uint32_t *vr, size_t nvr, void *e, void *log, void *update) {
    (void)n; (void)t; (void)r; (void)v; (void)l; (void)vr; (void)nvr; (void)e; (void)log; (void)update;
    Instance *m = calloc(1, sizeof *m);
    m->uses_events = events && early;
    return m;
}
API void *fmi3InstantiateModelExchange(const char *n, const char *t, const char *r, bool v, bool l, void *e, void *log) {
    (void)n; (void)t; (void)r; (void)v; (void)l; (void)e; (void)log;
    return calloc(1, sizeof(Instance));
}
API void fmi3FreeInstance(void *i) { free(i); }
API int fmi3Terminate(void *i) { (void)i; return OK; }
API int fmi3Reset(void *i) { (void)i; return OK; }
API int fmi3SetDebugLogging(void *i, bool on, size_t n, const char *const *c) { (void)i; (void)on; (void)n; (void)c; return OK; }
API int fmi3EnterInitializationMode(void *i, bool a, double b, double t0, bool c, double d) { THIS; (void)a; (void)b; (void)c; (void)d; m->v[TIME] = t0; return OK; }
API int fmi3ExitInitializationMode(void *i) { THIS; m->in_event_mode = true; return OK; }
API int fmi3EnterEventMode(void *i) { THIS; m->in_event_mode = true; return OK; }
API int fmi3EnterStepMode(void *i) { THIS; m->in_event_mode = false; return OK; }
API int fmi3EnterContinuousTimeMode(void *i) { THIS; m->in_event_mode = false; return OK; }
API int fmi3SetClock(void *i, const uint32_t *vr, size_t n, const bool *on) {
    THIS;
    if (!m->in_event_mode || n != 1 || vr[0] != CLOCK || !on[0]) return ERROR;
    m->active = true;
    return OK;
}
API int fmi3UpdateDiscreteStates(void *i, bool *again, bool *end, bool *nominals, bool *values, bool *defined, double *next) {
    THIS;
    if (!m->in_event_mode) return ERROR;
    *again = m->active; *end = *nominals = *values = *defined = false; *next = 0;
    if (m->active) { m->v[TICKS]++; m->v[LAST_TICK] = m->v[TIME]; m->active = false; }
    m->v[EVENTS]++;
    return OK;
}
API int fmi3DoStep(void *i, double t, double h, bool keep, bool *event, bool *end, bool *early, double *reached) {
    THIS; (void)keep;
    double x = m->v[X] + h * m->v[U];
    *event = *end = *early = false;
    if (m->uses_events && m->in_event_mode) return ERROR;
    if (m->v[STUCK] > 0.0) { *early = true; *reached = t; return OK; }
    if (m->uses_events && !m->passed && x >= 1.0) {
        h = (1.0 - m->v[X]) / m->v[U];
        m->passed = *event = *early = true;
        m->v[PASSED] = t + h;
        x = 1.0;
    }
    m->v[X] = x;
    m->v[TIME] = *reached = t + h;
    return OK;
}
API int fmi3GetFMUState(void *i, void **kept) {
    if (!*kept) *kept = malloc(sizeof(Instance));
    memcpy(*kept, i, sizeof(Instance));
    return OK;
}
API int fmi3SetFMUState(void *i, void *kept) { memcpy(i, kept, sizeof(Instance)); return OK; }
API int fmi3FreeFMUState(void *i, void **kept) { (void)i; free(*kept); *kept = NULL; return OK; }
API int fmi3SetTime(void *i, double t) { THIS; m->v[TIME] = t; return OK; }
API int fmi3SetContinuousStates(void *i, const double *x, size_t n) { THIS; (void)n; m->v[X] = x[0]; return OK; }
API int fmi3GetContinuousStates(void *i, double *x, size_t n) { THIS; (void)n; x[0] = m->v[X]; return OK; }
API int fmi3GetContinuousStateDerivatives(void *i, double *x, size_t n) { THIS; (void)n; x[0] = m->v[U]; return OK; }
API int fmi3GetNominalsOfContinuousStates(void *i, double *x, size_t n) { (void)i; (void)n; x[0] = 1.0; return OK; }
API int fmi3GetEventIndicators(void *i, double *z, size_t n) { (void)i; (void)z; (void)n; return OK; }
API int fmi3GetNumberOfContinuousStates(void *i, size_t *n) { (void)i; *n = 1; return OK; }
API int fmi3GetNumberOfEventIndicators(void *i, size_t *n) { (void)i; *n = 0; return OK; }
API int fmi3CompletedIntegratorStep(void *i, bool a, bool *event, bool *end) { (void)i; (void)a; *event = *end = false; return OK; }
API int fmi3GetFloat64(void *i, const uint32_t *vr, size_t n, double *v, size_t nv) { THIS; (void)nv; for (size_t k = 0; k < n; k++) v[k] = m->v[vr[k]]; return OK; }
API int fmi3SetFloat64(void *i, const uint32_t *vr, size_t n, const double *v, size_t nv) { THIS; (void)nv; for (size_t k = 0; k < n; k++) m->v[vr[k]] = v[k]; return OK; }
