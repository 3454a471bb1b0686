/* A source: points in time, a sine or a chirp; over a step it holds the value at the step's begin. */
#include <math.h>
#include <stdint.h>

enum { POINTS = 0, SINE = 1, LINEAR_CHIRP = 2, LOGARITHMIC_CHIRP = 3 };

typedef struct {
    int64_t kind;
    Points points;
    double mean, amplitude, omega, phase;
    double begin, duration; /* of a chirp; a sine begins at t0 */
    double rate;            /* of a chirp: half the slope of omega, or of its logarithm the whole */
} Source;

EXPORT int crankbench_source_step(void *self, double t, double h, const double *u, double *y)
{
    Source *s = (Source *)self;
    (void)h;
    (void)u;
    if (s->kind == POINTS) return points_value(&s->points, t, y);
    double since = t - s->begin, angle;
    if (s->kind == SINE) {
        angle = s->omega * since + s->phase;
    } else {
        since = since < 0.0 ? 0.0 : since > s->duration ? s->duration : since;
        angle = s->kind == LINEAR_CHIRP ? (s->omega + s->rate * since) * since + s->phase
                                        : s->omega * (expm1(s->rate * since) / s->rate) + s->phase;
    }
    y[0] = s->mean + s->amplitude * sin(angle);
    return OK;
}
