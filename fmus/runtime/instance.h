/* What an exported FMU is made of: the generated model's tables and functions, and one instance's data.
 *
 * The generated model.c defines the sizes (NX states, NM discrete states, NU inputs, NY outputs,
 * NZ event indicators, NP parameters, NS solver settings), the tables and the functions below, and
 * then includes instance.c, solve.c and one of fmi2.c, fmi3.c. Everything is one translation unit.
 *
 * A variable's value reference is its index in `v`:
 * [ time | x | x' | u | y | z | m | p | solver settings ]
 * NC is the number of constants that depend on the parameters alone.
 */
#ifndef CRANKBENCH_INSTANCE_H
#define CRANKBENCH_INSTANCE_H

#include <math.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define X0 1
#define DX0 (X0 + NX)
#define U0 (DX0 + NX)
#define Y0 (U0 + NU)
#define Z0 (Y0 + NY)
#define M0 (Z0 + NZ)
#define P0 (M0 + NM)
#define S0 (P0 + NP)
#define NV (S0 + NS)

/* Solver settings, present where the model has continuous states. */
#define METHOD S0
#define STEP_SIZE (S0 + 1)
#define TOLERANCE (S0 + 2)
enum { RK4 = 1, RODAS4 = 2 };

enum { REAL = 0, INTEGER = 1, BOOLEAN = 2 };

/* Numbered alike in FMI 2 and FMI 3. */
enum { OK = 0, WARNING = 1, DISCARD = 2, ERROR = 3, FATAL = 4 };

enum {
    INSTANTIATED = 1,
    INITIALIZATION = 2,
    STEP = 4,
    EVENT = 8,
    CONTINUOUS = 16,
    TERMINATED = 32,
    FAILED = 64
};

/* Tables of the model, one entry a value reference. */
static const char *const model_name[NV];
static const unsigned char model_kind[NV];
static const unsigned char model_settable[NV]; /* phases in which it may be set */
static const double model_start[NV];
static const double model_nominal[NX + 1];

/* Functions of the model; `c` is what depends on the parameters alone, computed once by model_constants. */
static void model_constants(const double *p, double *c);
static void model_derivatives(double t, const double *x, const double *m, const double *u, const double *p, const double *c, double *dx);
static void model_outputs(double t, const double *x, const double *m, const double *u, const double *p, const double *c, double *y);
static void model_indicators(double t, const double *x, const double *m, const double *u, const double *p, const double *c, double *z);
static void model_indicator_rates(double t, const double *x, const double *m, const double *u, const double *p, const double *c,
                                  double *dz);
static void model_jacobian(double t, const double *x, const double *m, const double *u, const double *p, const double *c, double *jx,
                           double *jt);
static void model_transition(double t, const double *x, const double *m, const double *u, const double *p, const double *c,
                             const double *above, double *xn, double *mn);
#if !KERNEL
static void model_sample(double t, const double *x, const double *m, const double *u, const double *p, const double *c, double *xn,
                         double *mn);
#endif
static void model_forward(double t, const double *x, const double *m, const double *u, const double *p, const double *c,
                          const double *sx, const double *su, const double *sp, double *sdx, double *sy);
static void model_reverse(double t, const double *x, const double *m, const double *u, const double *p, const double *c,
                          const double *ldx, const double *ly, double *lx, double *lu, double *lp);

/* All that getting, setting and serialising the FMU state copies. */
typedef struct {
    double v[NV];
    double c[NC + 1];
    double above[NZ + 1]; /* 1 where an indicator is positive, 0 where negative */
    double start_time;
    double next_step;     /* the adaptive method's next step, 0 where it must guess */
    int64_t sample_count; /* sampling instants passed */
    int32_t phase;
    int32_t stale;        /* what must be computed again before it is read */
    int32_t event_pending; /* FMI 3: an event was located and waits for the importer */
} State;

enum { STALE_DX = 1, STALE_Y = 2, STALE_Z = 4, STALE_M = 8, STALE_ALL = 15 };

typedef struct Instance {
    State s;
    char *name;
    int co_simulation;
    int logging;
    int event_mode_used; /* FMI 3 Co-Simulation: the importer has asked for event mode */
    int stop_at_events;  /* and for an early return at every event */
    double last_successful_time;
    void *environment;
    void (*logger)(void); /* the importer's callback, cast where it is called */
    void (*deliver)(struct Instance *, int status, const char *category, const char *message);
} Instance;

#if KERNEL
/* The sampling of a model that brings its own in C: OK, or what `fail` returned. */
static int kernel_sample(Instance *instance, double *xn, double *mn);
#endif

#endif
