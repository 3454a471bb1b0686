/* What the step loop is made of: parts on a flat bus of doubles, where the loop is, and what stopped it. */
#define _POSIX_C_SOURCE 199309L
#include <fenv.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

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
/* What an instant seldom does lies apart, so that what it always does fits the processor's caches of decoded code. */
#define SELDOM __attribute__((cold, noinline))

/* One instant in so many is timed: a prime, so that parts of every period have their share. */
enum { TIMED = 251, KEPT = 256 };

/* FMI's numbers of a status; those from DIVERGED on are ours. ENDED is no failure: the clock reached its stop. */
enum { OK = 0, WARNING = 1, ERROR = 3, FATAL = 4, DIVERGED = 5, STALLED = 6, ASTRAY = 7, ENDED = 8, UNSOLVED = 9 };

typedef int (*Step)(void *self, double t, double h, const double *u, double *y);
typedef struct Clock Clock;
typedef struct Group Group;

typedef struct {
    Step step;
    void *self;
    const double *u;       /* where the step reads its inputs: the bus itself, or `gathered` */
    double *gathered;
    const int64_t *inputs; /* places on the bus of the inputs to gather */
    int64_t gathers;       /* how many; 0 where u points into the bus */
    double *y;             /* where the step writes: the part's outputs on the bus */
    int64_t outputs;
    int64_t always;        /* 1: stepped alone, at every instant, from the one before */
    Group *group;          /* the first of parts that are stepped together; NULL else */
    int64_t period;        /* where it divides k, */
    const uint8_t *due;    /* or, where there is such a table, at the instants of a cycle that it marks */
    int64_t stepped;       /* the instant it was last stepped to, and its time; of parts not always stepped */
    double reached;
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
    Clock *clock;
    Part *parts; /* in the order they are stepped */
    int64_t count;
    double *bus;
    int64_t size; /* of the bus */
    const int64_t *recorded; /* places on the bus of the columns of a row; NULL where they are its first places */
    int64_t columns;
    int64_t every; /* a row is written where it divides k */
    Whereabouts *here;
    Group *steering; /* the parts up to the plant that a crank clock steers exactly; NULL else */
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

/* A part on a grid of its own in time: t0 + n h. Stepped to an instant, it makes the steps of its grid that end there
 * or before, and stands where it is between. A grid instant nearer than a millionth of h is at the instant. */
typedef struct {
    Step step;
    void *self;
    double t0, h;
    int64_t count; /* steps of the grid made */
} FixedGrid;

EXPORT int crankbench_grid_step(void *self, double t, double h, const double *u, double *y)
{
    FixedGrid *grid = (FixedGrid *)self;
    const double until = t + h + 1e-6 * grid->h;
    int all = OK;
    while (grid->t0 + (double)(grid->count + 1) * grid->h <= until) {
        const int status = grid->step(grid->self, grid->t0 + (double)grid->count * grid->h, grid->h, u, y);
        if (status != OK && status != WARNING) return status;
        all |= status;
        grid->count++;
    }
    return all;
}

/* Values of the instant before, for wires whose source is stepped earlier: copied before anything is stepped. */
EXPORT int crankbench_held_step(void *self, double t, double h, const double *u, double *y)
{
    (void)t;
    (void)h;
    memcpy(y, u, (size_t)(*(const int64_t *)self) * sizeof *y);
    return OK;
}

/* Notes what stopped the loop at a part, and returns the status. */
static SELDOM int stopped(const Loop *loop, const Part *part, int64_t k, int status, Stop *stop)
{
    stop->part = part - loop->parts;
    stop->output = -1;
    stop->k = k;
    return status;
}

/* Says of the first of the parts before `end` that has an output that is not finite; OK where all are. */
static SELDOM int diverged(const Loop *loop, const Part *end, int64_t k, Stop *stop)
{
    for (const Part *part = loop->parts; part < end; part++) {
        for (int64_t j = 0; j < part->outputs; j++) {
            if (isfinite(part->y[j])) continue;
            stopped(loop, part, k, DIVERGED, stop);
            stop->output = j;
            return DIVERGED;
        }
    }
    return OK;
}

/* What a status above OK of a part means to the loop: warnings are counted. */
static SELDOM int judged(const Loop *loop, Part *part, int64_t k, int status, Stop *stop)
{
    if (status == WARNING) {
        part->warnings++;
        return OK;
    }
    if (diverged(loop, part, k, stop)) return DIVERGED;
    return stopped(loop, part, k, status, stop);
}

/* A step of a part, timed. */
static SELDOM int timed_step(Part *part, double t, double h)
{
    const double begin = seconds();
    const int status = part->step(part->self, t, h, part->u, part->y);
    part->took[part->timed++ % KEPT] = seconds() - begin;
    return status;
}

/* Gathers a part's inputs and steps it. */
static inline int step_part(const Loop *loop, Part *part, double begin, double length, int64_t timed)
{
    const double *bus = loop->bus;
    for (int64_t j = 0; j < part->gathers; j++) part->gathered[j] = bus[part->inputs[j]];
    return timed ? timed_step(part, begin, length) : part->step(part->self, begin, length, part->u, part->y);
}
