/* A Model Exchange FMU, of FMI 1.0 where FMI1 is defined and of FMI 2.0 else. Three states: x integrates the input u,
 * r is driven by a relay, c counts events of time, one each 0.25 s. The parameter `mode` says how it misbehaves. */
#include <math.h>
#include <stdlib.h>
#include <string.h>
#if defined(_WIN32)
#define API __declspec(dllexport)
#else
#define API __attribute__((visibility("default")))
#endif
#ifdef FMI1
typedef char Boolean;
#define HEARER(m) (m)
#define FMI(name) exchange_fmi##name
#else
typedef int Boolean;
#define HEARER(m) (m)->callbacks.environment
#define FMI(name) fmi2##name
#endif
enum { OK, WARNING, DISCARD, ERROR, FATAL };
enum { PLAIN, CHATTER, RESTLESS, NAN_RATE, ERROR_RATE, DISCARD_RATE, END_AT_EVENT, END_AT_STEP, STEP_EVENT };
enum { U, X, R, TICKS, SWITCHES, STEP_EVENTS, DX, DR, REALS };
typedef void (*Logger)(void *, const char *, int, const char *, const char *, ...);
typedef struct {
    Logger logger;
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void *finished;
#ifndef FMI1
    void *environment;
#endif
} Callbacks;
typedef struct { Callbacks callbacks; double v[REALS]; double time, next; int mode, up; char label[64]; } Instance;
API char calls[65536];
static void note(char letter) { size_t n = strlen(calls); if (n + 1 < sizeof calls) calls[n] = letter; }

static void *made(Callbacks callbacks) {
    Instance *m = callbacks.allocate(1, sizeof *m);
    m->callbacks = callbacks;
    m->v[R] = 0.5;
    m->next = 0.25;
    note('I');
    return m;
}
/* r falls while it is above 0 and rises below, in mode CHATTER; else it swings between -1 and 1. */
static double rate(const Instance *m) { return m->mode == CHATTER ? (m->up ? -1.0 : 1.0) : (m->up ? 2.0 : -2.0); }
static double indicator(const Instance *m) {
    if (m->mode == CHATTER) return m->v[R];
    return m->up ? 1.0 - m->v[R] : m->v[R] + 1.0; /* positive until the end of the swing */
}
static void event(Instance *m) {
    note('E');
    if (m->time >= m->next - 1e-12) { m->v[TICKS]++; m->next += 0.25; }
    if (m->mode == CHATTER) {
        int up = m->v[R] > 0.0;
        if (up != m->up) { m->up = up; m->v[SWITCHES]++; }
    } else if (indicator(m) <= 0.0) { m->up = !m->up; m->v[SWITCHES]++; }
}
#define THIS Instance *m = i
API const char *FMI(GetVersion)(void) { return "x"; }
API int FMI(SetTime)(void *i, double t) { THIS; m->time = t; return OK; }
API int FMI(SetContinuousStates)(void *i, const double *x, size_t n) { THIS; (void)n; memcpy(&m->v[X], x, 2 * sizeof *x); return OK; }
API int FMI(GetContinuousStates)(void *i, double *x, size_t n) { THIS; (void)n; memcpy(x, &m->v[X], 2 * sizeof *x); return OK; }
API int FMI(GetDerivatives)(void *i, double *d, size_t n) {
    THIS; (void)n;
    d[0] = m->v[DX] = m->v[U];
    d[1] = m->v[DR] = rate(m);
    if (m->time > 0.6 && m->mode == NAN_RATE) d[0] = NAN;
    if (m->time > 0.6 && m->mode == ERROR_RATE) {
        m->callbacks.logger(HEARER(m), "x", ERROR, "solver", "lost at %.1f", 0.6);
        return ERROR;
    }
    return m->time > 0.6 && m->mode == DISCARD_RATE ? DISCARD : OK;
}
API int FMI(GetEventIndicators)(void *i, double *z, size_t n) { THIS; (void)n; z[0] = indicator(m); return OK; }
API int FMI(GetReal)(void *i, const unsigned *vr, size_t n, double *v) { THIS; for (size_t k = 0; k < n; k++) v[k] = m->v[vr[k]]; return OK; }
API int FMI(SetReal)(void *i, const unsigned *vr, size_t n, const double *v) { THIS; for (size_t k = 0; k < n; k++) m->v[vr[k]] = v[k]; note('s'); return OK; }
API int FMI(GetInteger)(void *i, const unsigned *vr, size_t n, int *v) { THIS; (void)vr; for (size_t k = 0; k < n; k++) v[k] = m->mode; return OK; }
API int FMI(SetInteger)(void *i, const unsigned *vr, size_t n, const int *v) { THIS; (void)vr; for (size_t k = 0; k < n; k++) m->mode = v[k]; return OK; }
API int FMI(GetBoolean)(void *i, const unsigned *vr, size_t n, Boolean *v) { THIS; (void)vr; for (size_t k = 0; k < n; k++) v[k] = (Boolean)m->up; return OK; }
API int FMI(SetBoolean)(void *i, const unsigned *vr, size_t n, const Boolean *v) { THIS; (void)vr; for (size_t k = 0; k < n; k++) m->up = v[k]; return OK; }
API int FMI(GetString)(void *i, const unsigned *vr, size_t n, const char **v) { THIS; (void)vr; for (size_t k = 0; k < n; k++) v[k] = m->label; return OK; }
API int FMI(SetString)(void *i, const unsigned *vr, size_t n, const char *const *v) { THIS; (void)vr; for (size_t k = 0; k < n; k++) strncpy(m->label, v[k], 63); return OK; }
API int FMI(Terminate)(void *i) { (void)i; note('T'); return OK; }
#ifdef FMI1
typedef struct { char converged, references, values, terminate, upcoming; double next; } Info;
static void inform(Instance *m, Info *info) {
    *info = (Info){m->mode != RESTLESS, 0, 0, m->mode == END_AT_EVENT && m->time >= 0.5, 1, m->next};
}
API void *exchange_fmiInstantiateModel(const char *name, const char *guid, Callbacks callbacks, char logging) {
    (void)logging;
    if (strcmp(guid, "{exchange}")) { callbacks.logger(NULL, name, ERROR, "", "wrong guid"); return NULL; }
    return made(callbacks);
}
API void exchange_fmiFreeModelInstance(void *i) { note('F'); ((Instance *)i)->callbacks.release(i); }
API int exchange_fmiSetDebugLogging(void *i, char on) { (void)i; (void)on; return OK; }
API int exchange_fmiInitialize(void *i, char controlled, double tolerance, Info *info) {
    THIS; (void)controlled; (void)tolerance; note('['); event(m); inform(m, info); return OK;
}
API int exchange_fmiEventUpdate(void *i, char intermediate, Info *info) { THIS; (void)intermediate; event(m); inform(m, info); return OK; }
API int exchange_fmiGetNominalContinuousStates(void *i, double *x, size_t n) { (void)i; for (size_t k = 0; k < n; k++) x[k] = 1.0; return OK; }
API int exchange_fmiGetStateValueReferences(void *i, unsigned *references, size_t n) { (void)i; for (size_t k = 0; k < n; k++) references[k] = X + k; return OK; }
API int exchange_fmiCompletedIntegratorStep(void *i, char *wants) {
    THIS; *wants = m->mode == STEP_EVENT && m->v[STEP_EVENTS] < 3;
    if (*wants) m->v[STEP_EVENTS]++;
    return OK;
}
#else
typedef struct { int again, terminate, nominals, values, upcoming; double next; } Info;
API const char *fmi2GetTypesPlatform(void) { return "default"; }
API void *fmi2Instantiate(const char *name, int type, const char *guid, const char *where, const Callbacks *callbacks, int visible, int logging) {
    (void)name; (void)where; (void)visible; (void)logging;
    return type == 0 && !strcmp(guid, "{exchange}") ? made(*callbacks) : NULL;
}
API void fmi2FreeInstance(void *i) { note('F'); ((Instance *)i)->callbacks.release(i); }
API int fmi2SetDebugLogging(void *i, int on, size_t n, const char *const *names) { (void)i; (void)on; (void)n; (void)names; return OK; }
API int fmi2SetupExperiment(void *i, int a, double b, double t0, int c, double d) { THIS; (void)a; (void)b; (void)c; (void)d; note('x'); m->time = t0; return OK; }
API int fmi2EnterInitializationMode(void *i) { (void)i; note('['); return OK; }
API int fmi2ExitInitializationMode(void *i) { (void)i; note(']'); return OK; }
API int fmi2Reset(void *i) {
    THIS;
    Callbacks callbacks = m->callbacks;
    *m = (Instance){.callbacks = callbacks, .v[R] = 0.5, .next = 0.25};
    return OK;
}
API int fmi2GetFMUstate(void *i, void **kept) {
    if (!*kept) *kept = malloc(sizeof(Instance));
    memcpy(*kept, i, sizeof(Instance));
    return OK;
}
API int fmi2SetFMUstate(void *i, void *kept) { memcpy(i, kept, sizeof(Instance)); return OK; }
API int fmi2FreeFMUstate(void *i, void **kept) { (void)i; free(*kept); *kept = NULL; return OK; }
API int fmi2EnterEventMode(void *i) { (void)i; note('e'); return OK; }
API int fmi2EnterContinuousTimeMode(void *i) { (void)i; note('c'); return OK; }
API int fmi2NewDiscreteStates(void *i, Info *info) {
    THIS; event(m);
    *info = (Info){m->mode == RESTLESS, m->mode == END_AT_EVENT && m->time >= 0.5, 0, 0, 1, m->next};
    return OK;
}
API int fmi2GetNominalsOfContinuousStates(void *i, double *x, size_t n) { (void)i; for (size_t k = 0; k < n; k++) x[k] = 1.0; return OK; }
API int fmi2CompletedIntegratorStep(void *i, int no_prior, int *wants, int *end) {
    THIS; (void)no_prior;
    *wants = m->mode == STEP_EVENT && m->v[STEP_EVENTS] < 3;
    if (*wants) m->v[STEP_EVENTS]++;
    *end = m->mode == END_AT_STEP && m->time > 0.3;
    return OK;
}
#endif
