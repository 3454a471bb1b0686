/* An FMI 2.0 FMU that integrates its input and misbehaves in one way, named by its guid, from t = AT on or in the stage
 * that the way is named after. */
#define _GNU_SOURCE
#include <fenv.h>
#include <math.h>
#include <pthread.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#define FMI __attribute__((visibility("default")))
#define AT 0.02 /* s */
typedef void (*Logger)(void *, const char *, int, const char *, const char *, ...);
typedef struct {
    Logger logger;
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void *finished, *environment;
} Callbacks;
typedef struct { const Callbacks *callbacks; char way[64]; double u, x; } Instance;
static int gone; /* an instance reported fatal: nothing may be called any more */
static void alive(void) { if (gone) abort(); }
static int is(const Instance *i, const char *way) { return !strcmp(i->way, way); }
static void hang(void) { for (;;) usleep(1000); }
static void crash(void) { *(volatile int *)8 = 1; }
static void *crashing(void *delay) { unsigned us = *(unsigned *)delay; while (us) { us -= 1000; usleep(1000); } crash(); return NULL; }
static void start_thread(unsigned *delay) { pthread_t thread; pthread_create(&thread, NULL, crashing, delay); }
static int overflow(volatile char *below) {
    volatile char here[4096];
    here[0] = below[0];
    return overflow(here) + here[1];
}
FMI const char *fmi2GetTypesPlatform(void) { return "default"; }
FMI const char *fmi2GetVersion(void) { return "2.0"; }
FMI void *fmi2Instantiate(const char *name, int type, const char *guid, const char *where, const Callbacks *callbacks,
                          int visible, int logging) {
    (void)name; (void)type; (void)where; (void)visible; (void)logging;
    alive();
    Instance *i = callbacks->allocate(1, sizeof *i);
    i->callbacks = callbacks;
    strncpy(i->way, guid, sizeof i->way - 1);
    if (is(i, "hang in instantiate")) hang();
    if (is(i, "crash in instantiate")) crash();
    return i;
}
FMI void fmi2FreeInstance(void *c) {
    Instance *i = c;
    alive();
    if (is(i, "crash in free")) crash();
    i->callbacks->release(i);
}
FMI int fmi2SetDebugLogging(void *i, int on, size_t n, const char *const *names) {
    (void)i; (void)on; (void)n; (void)names; return 0;
}
FMI int fmi2SetupExperiment(void *i, int a, double b, double t0, int c, double d) {
    (void)i; (void)a; (void)b; (void)t0; (void)c; (void)d; return 0;
}
FMI int fmi2EnterInitializationMode(void *c) {
    if (is(c, "hang in initialise")) hang();
    if (is(c, "crash in initialise")) crash();
    return 0;
}
FMI int fmi2ExitInitializationMode(void *i) { (void)i; return 0; }
FMI int fmi2Terminate(void *c) {
    alive();
    if (is(c, "hang in terminate")) hang();
    if (is(c, "crash in terminate")) crash();
    return 0;
}
FMI int fmi2Reset(void *i) { (void)i; return 3; }
FMI int fmi2GetReal(void *c, const unsigned *vr, size_t n, double *v) {
    (void)vr;
    alive();
    for (size_t k = 0; k < n; k++) v[k] = ((Instance *)c)->x;
    return 0;
}
FMI int fmi2SetReal(void *c, const unsigned *vr, size_t n, const double *v) {
    (void)vr;
    alive();
    for (size_t k = 0; k < n; k++) ((Instance *)c)->u = v[k];
    return 0;
}
static int misbehave(Instance *i, double t, double h) {
    static unsigned at_once = 0, late = 3000000; /* us */
    if (is(i, "segmentation fault")) crash();
    if (is(i, "abort")) { puts("about to abort"); abort(); }
    if (is(i, "exit 0")) exit(0);
    if (is(i, "exit 3")) exit(3);
    if (is(i, "kill")) raise(SIGKILL);
    if (is(i, "stack overflow")) { char c = 0; return overflow(&c); }
    if (is(i, "hang")) hang();
    if (is(i, "hang, deaf")) {
        sigset_t all;
        sigfillset(&all);
        sigprocmask(SIG_BLOCK, &all, NULL);
        signal(SIGTERM, SIG_IGN);
        signal(SIGINT, SIG_IGN);
        for (;;) pause();
    }
    if (is(i, "thread crashes")) { start_thread(&at_once); hang(); }
    if (is(i, "thread crashes later")) { static int once; if (!once++) { start_thread(&late); usleep(20000); } }
    if (is(i, "child stays")) { static int once; if (!once++ && !fork()) for (;;) pause(); }
    if (is(i, "closes all files")) for (int f = 3; f < 1024; f++) close(f);
    if (is(i, "memory")) { static char *volatile kept; size_t n = 64 << 20; kept = memset(malloc(n), 1, n); }
    if (is(i, "flood") && t + 0.5 * h < AT) for (int k = 0; k < 20000; k++) printf("a line of 40 letters on standard output\n");
    if (is(i, "rounds up")) fesetround(FE_UPWARD);
    if (is(i, "interrupts")) raise(SIGINT);
    if (is(i, "changes folder")) { if (chdir("/")) return 3; }
    if (is(i, "discard")) return 2;
    if (is(i, "error")) return 3;
    if (is(i, "fatal")) { gone = 1; return 4; }
    if (is(i, "not a number")) i->x = NAN;
    if (is(i, "infinity")) i->x = INFINITY;
    return 0;
}
FMI int fmi2DoStep(void *c, double t, double h, int b) {
    Instance *i = c;
    (void)b;
    alive();
    i->x += h * i->u;
    return t + 1.5 * h > AT ? misbehave(i, t, h) : 0;
}
FMI int fmi2CancelStep(void *i) { (void)i; return 3; }
FMI int fmi2GetStatus(void *i, int k, int *v) { (void)i; (void)k; (void)v; return 2; }
FMI int fmi2GetRealStatus(void *i, int k, double *v) { (void)i; (void)k; (void)v; return 2; }
FMI int fmi2GetIntegerStatus(void *i, int k, int *v) { (void)i; (void)k; (void)v; return 2; }
FMI int fmi2GetBooleanStatus(void *i, int k, int *v) { (void)i; (void)k; (void)v; return 2; }
FMI int fmi2GetStringStatus(void *i, int k, const char **v) { (void)i; (void)k; (void)v; return 2; }
#define ABSENT(name) FMI int name(void) { return 3; }
ABSENT(fmi2GetInteger) ABSENT(fmi2SetInteger) ABSENT(fmi2GetBoolean) ABSENT(fmi2SetBoolean) ABSENT(fmi2GetString)
ABSENT(fmi2SetString)
ABSENT(fmi2GetFMUstate) ABSENT(fmi2SetFMUstate) ABSENT(fmi2FreeFMUstate) ABSENT(fmi2SerializedFMUstateSize)
ABSENT(fmi2SerializeFMUstate) ABSENT(fmi2DeSerializeFMUstate) ABSENT(fmi2GetDirectionalDerivative)
ABSENT(fmi2SetRealInputDerivatives) ABSENT(fmi2GetRealOutputDerivatives)
