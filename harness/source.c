/* A source: points in time, held or joined by lines, or a sine; over a step it holds the value at the step's begin. */
#include <math.h>
#include <stdint.h>

enum { HOLD = 0, LINEAR = 1, SINE = 2 };

typedef struct {
    int64_t kind;
    int64_t count;
    const double *times, *values; /* ascending times; the ends are held */
    double mean, amplitude, omega, phase, t0;
    double edge; /* a point nearer than this to t is at t */
} Source;

EXPORT int crankbench_source_step(void *self, double t, double h, const double *u, double *y)
{
    const Source *s = (const Source *)self;
    (void)h;
    (void)u;
    if (s->kind == SINE) {
        y[0] = s->mean + s->amplitude * sin(s->omega * (t - s->t0) + s->phase);
        return OK;
    }
    const double now = s->kind == HOLD ? t + s->edge : t;
    int64_t low = 0, high = s->count; /* times[low] <= now < times[high], as far as there are points */
    while (high - low > 1) {
        const int64_t middle = (low + high) / 2;
        if (s->times[middle] <= now) low = middle;
        else high = middle;
    }
    if (s->kind == HOLD || low == s->count - 1 || now <= s->times[low]) {
        y[0] = s->values[low];
        return OK;
    }
    const double share = (now - s->times[low]) / (s->times[low + 1] - s->times[low]);
    y[0] = s->values[low] + share * (s->values[low + 1] - s->values[low]);
    return OK;
}
