/* An FMI 1.0 Co-Simulation FMU: gives back its inputs, sums one, and misbehaves in its third step as `mode` says. */
#include <stdlib.h>
#include <string.h>
#if defined(_WIN32)
#define API __declspec(dllexport)
#else
#define API __attribute__((visibility("default")))
#endif
#define FMI(name) relay_fmi##name
enum { OK, WARNING, DISCARD, ERROR, FATAL, PENDING };
typedef void (*Logger)(void *, const char *, int, const char *, const char *, ...);
typedef struct { Logger logger; void *(*allocate)(size_t, size_t); void (*release)(void *); void *finished; } Callbacks;
typedef struct { Callbacks callbacks; double reals[4]; int integers[3]; char booleans[2]; char text[64]; double t; int steps; } Instance;
API char calls[4096];
static void note(char letter) { size_t n = strlen(calls); if (n + 1 < sizeof calls) calls[n] = letter; }
#define THIS Instance *m = i
#define LOG(status, ...) m->callbacks.logger(m, "relay", status, "log", __VA_ARGS__)
API const char *FMI(GetTypesPlatform)(void) { return "standard32"; }
API const char *FMI(GetVersion)(void) { return "1.0"; }
API void *FMI(InstantiateSlave)(const char *name, const char *guid, const char *where, const char *mime, double timeout,
                                char visible, char interactive, Callbacks callbacks, char logging) {
    (void)where; (void)timeout; (void)visible; (void)interactive; (void)logging;
    if (strcmp(guid, "{relay}") || strcmp(mime, "application/x-fmu-sharedlibrary")) return NULL;
    if (!strcmp(name, "unwanted")) { callbacks.logger(NULL, name, ERROR, "log", "no licence for %s", name); return NULL; }
    Instance *m = callbacks.allocate(1, sizeof *m);
    m->callbacks = callbacks;
    note('I');
    return m;
}
API int FMI(InitializeSlave)(void *i, double t0, char stops, double stop) {
    THIS; (void)stops; (void)stop; m->t = t0; note('['); LOG(OK, "from %.1f", t0); return m->integers[0] == 9 ? ERROR : OK;
}
API int FMI(TerminateSlave)(void *i) { (void)i; note('T'); return OK; }
API int FMI(ResetSlave)(void *i) { THIS; m->steps = 0; note('R'); return OK; }
API void FMI(FreeSlaveInstance)(void *i) { note('F'); ((Instance *)i)->callbacks.release(i); }
API int FMI(SetDebugLogging)(void *i, char on) { (void)i; note(on ? 'L' : 'l'); return OK; }
API int FMI(DoStep)(void *i, double t, double h, char fresh) {
    THIS; (void)fresh;
    note('D');
    m->reals[1] = m->reals[0];
    m->reals[2] += h * m->reals[0];
    m->integers[2] = m->integers[1];
    m->booleans[1] = m->booleans[0];
    m->t = t + h;
    if (++m->steps < 3) return OK;
    switch (m->integers[0]) {
    case 1: return WARNING;
    case 2: m->t = t + h / 2; LOG(DISCARD, "step %d is too long", m->steps); return DISCARD;
    case 3: LOG(ERROR, "lost at %.2f", t); return ERROR;
    case 4: LOG(FATAL, "gone"); return FATAL;
    case 5: return PENDING;
    }
    return OK;
}
API int FMI(CancelStep)(void *i) { (void)i; return OK; }
API int FMI(GetStatus)(void *i, int kind, int *v) { (void)i; (void)kind; *v = OK; return OK; }
API int FMI(GetRealStatus)(void *i, int kind, double *v) { THIS; *v = m->t; return kind == 2 ? OK : DISCARD; }
API int FMI(GetReal)(void *i, const unsigned *vr, size_t n, double *v) { THIS; for (size_t k = 0; k < n; k++) v[k] = m->reals[vr[k]]; note('g'); return OK; }
API int FMI(SetReal)(void *i, const unsigned *vr, size_t n, const double *v) { THIS; for (size_t k = 0; k < n; k++) m->reals[vr[k]] = v[k]; note('s'); return OK; }
API int FMI(GetInteger)(void *i, const unsigned *vr, size_t n, int *v) { THIS; for (size_t k = 0; k < n; k++) v[k] = m->integers[vr[k]]; note('g'); return OK; }
API int FMI(SetInteger)(void *i, const unsigned *vr, size_t n, const int *v) { THIS; for (size_t k = 0; k < n; k++) m->integers[vr[k]] = v[k]; note('s'); return OK; }
API int FMI(GetBoolean)(void *i, const unsigned *vr, size_t n, char *v) { THIS; for (size_t k = 0; k < n; k++) v[k] = m->booleans[vr[k]]; note('g'); return OK; }
API int FMI(SetBoolean)(void *i, const unsigned *vr, size_t n, const char *v) { THIS; for (size_t k = 0; k < n; k++) m->booleans[vr[k]] = v[k]; note('s'); return OK; }
API int FMI(GetString)(void *i, const unsigned *vr, size_t n, const char **v) { THIS; (void)vr; for (size_t k = 0; k < n; k++) v[k] = m->text; return OK; }
API int FMI(SetString)(void *i, const unsigned *vr, size_t n, const char *const *v) {
    THIS; (void)vr; (void)n; strncpy(m->text, v[0], 63); LOG(OK, "text %s", v[0]); note('s'); return OK;
}
