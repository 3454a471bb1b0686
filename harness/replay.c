/* A replay: the points of several recorded signals; a step ends with their values at its end. */
#include <stdint.h>

typedef struct {
    int64_t count;
    Points *signals;
    int64_t counts; /* 1: the points are over the crank angle that the clock counts, 0: over time */
    double numerator, denominator, origin; /* of the clock [deg], see clock.c */
    int64_t k, kept; /* instants counted, and how many when it was kept */
} Replay;

static int replay_values(const Replay *s, double t, double *y)
{
    const double at = s->counts ? s->origin + (double)s->k * s->numerator / s->denominator : t;
    for (int64_t i = 0; i < s->count; i++) {
        const int status = points_value(&s->signals[i], at, &y[i]);
        if (status != OK) return status;
    }
    return OK;
}

EXPORT int crankbench_replay_start(void *self, double t, const double *u, double *y)
{
    Replay *s = (Replay *)self;
    (void)u;
    s->k = 0;
    return replay_values(s, t, y);
}

EXPORT int crankbench_replay_step(void *self, double t, double h, const double *u, double *y)
{
    Replay *s = (Replay *)self;
    (void)u;
    s->k++;
    return replay_values(s, t + h, y);
}

EXPORT int crankbench_replay_keep(void *self)
{
    Replay *s = (Replay *)self;
    s->kept = s->k;
    return OK;
}

EXPORT int crankbench_replay_restore(void *self)
{
    Replay *s = (Replay *)self;
    s->k = s->kept;
    return OK;
}
