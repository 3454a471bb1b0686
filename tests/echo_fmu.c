/* An FMI 2.0 FMU that gives back its inputs, notes every call made on it, and misbehaves in its third step as the
 * parameter `mode` says. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#if defined(_WIN32)
#define FMI __declspec(dllexport)
#else
#define FMI __attribute__((visibility("default")))
#endif
typedef void (*Logger)(void *, const char *, int, const char *, const char *, ...);
typedef struct {
    Logger logger;
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void *finished, *environment;
} Callbacks;
typedef struct { const Callbacks *callbacks; double reals[16]; int integers[16]; int steps; } Instance;
FMI char calls[4096]; /* a letter for each call on an instance */
static void note(char letter) { size_t n = strlen(calls); if (n + 1 < sizeof calls) calls[n] = letter; }
#define LOG(instance, status, category, ...) \
    (instance)->callbacks->logger((instance)->callbacks->environment, "echo", status, category, __VA_ARGS__)
#define MODE integers[0]
FMI const char *fmi2GetTypesPlatform(void) { return "default"; }
FMI const char *fmi2GetVersion(void) { return "2.0"; }
FMI void *fmi2Instantiate(const char *name, int type, const char *guid, const char *where, const Callbacks *callbacks,
                          int visible, int logging) {
    (void)type; (void)where; (void)visible; (void)logging;
    if (strcmp(guid, "{echo}")) return NULL;
    if (!strcmp(name, "unwanted")) {
        callbacks->logger(callbacks->environment, name, 3, "logStatusError", "no licence for %s", name);
        return NULL;
    }
    Instance *instance = callbacks->allocate(1, sizeof *instance);
    instance->callbacks = callbacks;
    note('I');
    return instance;
}
FMI void fmi2FreeInstance(void *i) { note('F'); ((Instance *)i)->callbacks->release(i); }
FMI int fmi2SetDebugLogging(void *i, int on, size_t n, const char *const *names) {
    for (size_t k = 0; k < n; k++) LOG((Instance *)i, 0, "set-up", "%s %s", names[k], on ? "on" : "off");
    return 0;
}
FMI int fmi2SetupExperiment(void *i, int a, double b, double t0, int c, double d) {
    (void)i; (void)a; (void)b; (void)t0; (void)c; (void)d; note('x'); return 0;
}
FMI int fmi2EnterInitializationMode(void *i) { note('['); return ((Instance *)i)->MODE == 9 ? 3 : 0; }
FMI int fmi2ExitInitializationMode(void *i) { (void)i; note(']'); return 0; }
FMI int fmi2Terminate(void *i) { (void)i; note('T'); return 0; }
FMI int fmi2Reset(void *i) { (void)i; note('R'); return 0; }
FMI int fmi2GetReal(void *i, const unsigned *vr, size_t n, double *v) {
    for (size_t k = 0; k < n; k++) v[k] = ((Instance *)i)->reals[vr[k]];
    note('g'); return 0;
}
FMI int fmi2SetReal(void *i, const unsigned *vr, size_t n, const double *v) {
    for (size_t k = 0; k < n; k++) ((Instance *)i)->reals[vr[k]] = v[k];
    note('s'); return 0;
}
FMI int fmi2GetInteger(void *i, const unsigned *vr, size_t n, int *v) {
    for (size_t k = 0; k < n; k++) v[k] = ((Instance *)i)->integers[vr[k]];
    note('g'); return 0;
}
FMI int fmi2SetInteger(void *i, const unsigned *vr, size_t n, const int *v) {
    for (size_t k = 0; k < n; k++) ((Instance *)i)->integers[vr[k]] = v[k];
    note('s'); return 0;
}
FMI int fmi2GetBoolean(void *i, const unsigned *vr, size_t n, int *v) { return fmi2GetInteger(i, vr, n, v); }
FMI int fmi2SetBoolean(void *i, const unsigned *vr, size_t n, const int *v) { return fmi2SetInteger(i, vr, n, v); }
FMI int fmi2GetString(void *i, const unsigned *vr, size_t n, const char **v) {
    (void)i; (void)vr; (void)n; (void)v; return 3;
}
FMI int fmi2SetString(void *i, const unsigned *vr, size_t n, const char *const *v) {
    (void)vr; (void)n; LOG((Instance *)i, 0, "set-up", "text %s", v[0]); return 0;
}
FMI int fmi2DoStep(void *c, double t, double h, int b) {
    Instance *i = c; (void)t; (void)h; (void)b;
    note('D');
    i->steps++;
    switch (i->steps == 3 ? i->MODE : 0) {
    case 1: return 1;
    case 2: LOG(i, 2, "logStatusDiscard", "step %d of %g s is too long", i->steps, h); return 2;
    case 3: LOG(i, 3, "logStatusError", "lost at %.2f", t); return 3;
    case 4: LOG(i, 4, "logStatusFatal", "gone"); return 4;
    case 5: return 5;
    case 6: for (int k = 0; k < 1000; k++) LOG(i, 1, "many", "message %d", k); break;
    case 7: LOG(i, 1, "odd", "100 %% %n"); LOG(i, 1, "odd", "half done: 50%"); break;
    case 8: { char text[3000]; memset(text, 'x', 2999); text[2999] = 0; LOG(i, 1, NULL, "%s", text); } break;
    }
    return 0;
}
FMI int fmi2CancelStep(void *i) { (void)i; return 3; }
FMI int fmi2GetStatus(void *i, int k, int *v) { (void)i; (void)k; (void)v; return 2; }
FMI int fmi2GetRealStatus(void *i, int k, double *v) { (void)i; (void)k; *v = 0.25; return 0; }
FMI int fmi2GetIntegerStatus(void *i, int k, int *v) { (void)i; (void)k; (void)v; return 2; }
FMI int fmi2GetBooleanStatus(void *i, int k, int *v) { (void)i; (void)k; *v = 0; return 0; }
FMI int fmi2GetStringStatus(void *i, int k, const char **v) { (void)i; (void)k; (void)v; return 2; }
#define ABSENT(name) FMI int name(void) { return 3; }
ABSENT(fmi2GetFMUstate) ABSENT(fmi2SetFMUstate) ABSENT(fmi2FreeFMUstate) ABSENT(fmi2SerializedFMUstateSize)
ABSENT(fmi2SerializeFMUstate) ABSENT(fmi2DeSerializeFMUstate) ABSENT(fmi2GetDirectionalDerivative)
ABSENT(fmi2SetRealInputDerivatives) ABSENT(fmi2GetRealOutputDerivatives)
