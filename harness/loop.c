/* The step loop: steps a table of parts over a flat bus of doubles and records rows of it. */
#define _POSIX_C_SOURCE 199309L
#include <fenv.h>
#include <math.h>
#include <stdint.h>

#ifdef _WIN32
#include <windows.h>
#define EXPORT __declspec(dllexport)
static double seconds(void)
{
    LARGE_INTEGER count, rate;
    QueryPerformanceCounter(&count);
    QueryPerformanceFrequency(&rate);
    return (double)count.QuadPart / (double)rate.QuadPart;
}
#else
#include <time.h>
#define EXPORT __attribute__((visibility("default")))
static double seconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}
#endif
/* What an instant seldom does lies apart from what it always does: measured, a step is some 5 % faster so. */
/* What an instant seldom does lies apart, so that what it always does fits the processor's caches of decoded code. */
#define SELDOM __attribute__((cold, noinline))

/* One instant in so many is timed: a prime, so that parts of every period have their share. */
enum { TIMED = 251, KEPT = 256 };

/* FMI's numbers of a status; DIVERGED is ours. */
enum { OK = 0, WARNING = 1, ERROR = 3, FATAL = 4, DIVERGED = 5 };

typedef int (*Step)(void *self, double t, double h, const double *u, double *y);

typedef struct {
    Step step;
    void *self;
    const double *u;       /* where the step reads its inputs: the bus itself, or `gathered` */
    double *gathered;
    const int64_t *inputs; /* places on the bus of the inputs to gather */
    int64_t gathers;       /* how many; 0 where u points into the bus */
    double *y;             /* where the step writes: the part's outputs on the bus */
    int64_t outputs;
    int64_t period;        /* in steps of the clock */
    int64_t warnings;      /* counted here */
    int64_t timed;         /* steps that were timed */
    double *took;          /* how long the last KEPT of them took [s] */
} Part;

/* Where the loop is, for another process that reads it when this one has crashed or hangs: rows before `instant` are
 * complete, `part` is being stepped to it. The beginning of the one in whereabouts.py. */
typedef struct {
    volatile int64_t instant;
    const Part *volatile part;
} Whereabouts;

typedef struct {
    double t0, h;
    Part *parts; /* in the order they are stepped */
    int64_t count;
    const double *bus;
    int64_t size; /* of the bus */
    const int64_t *recorded; /* places on the bus of the columns of a row; NULL where a row is the bus */
    int64_t columns;
    Whereabouts *here;
} Loop;

typedef struct {
    int64_t part;   /* index into `parts` of the one that stopped the loop */
    int64_t output; /* index of its first non-finite output, where it diverged */
    int64_t k;      /* the instant it was stepped to */
} Stop;

/* Rounding and the like as a process begins with them: a library may have changed them as it was loaded. */
EXPORT void crankbench_settle(void)
{
    fesetenv(FE_DFL_ENV);
}

/* A part written in Python. `call` cannot pass on what is raised, not even a signal that arrives at its first line, so
 * the step counts as FATAL unless Python says otherwise at its last. */
typedef struct {
    void (*call)(double t, double h);
    int64_t status;
} PythonPart;

EXPORT int crankbench_python_step(void *self, double t, double h, const double *u, double *y)
{
    PythonPart *part = (PythonPart *)self;
    (void)u;
    (void)y;
    part->status = FATAL;
    part->call(t, h);
    return (int)part->status;
}

/* Says of the first of the parts stepped so far that has an output that is not finite; OK where all are. */
static SELDOM int diverged(const Loop *loop, int64_t stepped, int64_t k, Stop *stop)
{
    for (int64_t i = 0; i < stepped; i++) {
        const Part *part = &loop->parts[i];
        for (int64_t j = 0; j < part->outputs; j++) {
            if (isfinite(part->y[j])) continue;
            stop->part = i;
            stop->output = j;
            stop->k = k;
            return DIVERGED;
        }
    }
    return OK;
}

/* A step of a part, timed. */
static SELDOM int timed_step(Part *part, double t, double h)
{
    const double begin = seconds();
    const int status = part->step(part->self, t, h, part->u, part->y);
    part->took[part->timed++ % KEPT] = seconds() - begin;
    return status;
}

/* The sum of some numbers: it is not finite where one of them is not, or where it overflows itself. */
static inline double sum(const double *values, int64_t count)
{
    double total = 0.0;
    for (int64_t j = 0; j < count; j++) total += values[j];
    return total;
}

/* Copies numbers and returns their sum. */
static inline double copied(double *to, const double *values, int64_t count)
{
    double total = 0.0;
    for (int64_t j = 0; j < count; j++) {
        const double value = values[j];
        to[j] = value;
        total += value;
    }
    return total;
}

/* Steps from instant `from` to instant `to`, t_k = t0 + k h, and writes rows from+1 ... to, each of `columns` doubles.
 * Returns OK; or the status above WARNING, or DIVERGED, that stopped it: then `stop` says where, and the row of that
 * instant is not written. Outputs are looked at once an instant: a part that fails on what another left is no culprit. */
EXPORT int crankbench_advance(const Loop *loop, int64_t from, int64_t to, double *rows, Stop *stop)
{
    const double t0 = loop->t0, h = loop->h;
    const double *bus = loop->bus;
    const int64_t *recorded = loop->recorded;
    const int64_t columns = loop->columns, size = loop->size;
    Part *const parts = loop->parts, *const end = parts + loop->count;
    Whereabouts *const here = loop->here;
    int64_t timed = from + TIMED - from % TIMED; /* the next instant to time */

    for (int64_t k = from + 1; k <= to; k++) {
        const double t = t0 + (double)(k - 1) * h;
        here->instant = k;
        for (Part *part = parts; part < end; part++) {
            here->part = part;
            double begin = t, length = h;
            if (part->period != 1) {
                if (k % part->period != 0) continue;
                begin = t0 + (double)(k - part->period) * h;
                length = (double)part->period * h;
            }
            for (int64_t j = 0; j < part->gathers; j++) part->gathered[j] = bus[part->inputs[j]];
            const int status = k == timed ? timed_step(part, begin, length)
                                          : part->step(part->self, begin, length, part->u, part->y);
            if (status == OK) continue;
            if (status != WARNING) {
                if (diverged(loop, part - parts, k, stop)) return DIVERGED;
                stop->part = part - parts;
                stop->output = -1;
                stop->k = k;
                return status;
            }
            part->warnings++;
        }
        if (k == timed) timed += TIMED;
        double check;
        if (recorded) {
            check = sum(bus, size);
            for (int64_t j = 0; j < columns; j++) rows[j] = bus[recorded[j]];
        } else {
            check = copied(rows, bus, size);
        }
        if (!isfinite(check) && diverged(loop, loop->count, k, stop)) return DIVERGED;
        rows += columns;
    }
    here->instant = to + 1;
    return OK;
}
