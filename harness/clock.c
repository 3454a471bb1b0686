/* The clock: instants evenly spaced in time, or in crank angle with times that follow from the engine's speed. */

struct Clock {
    double t0, h;          /* t_k = t0 + k h on a clock in time */
    /* the rest is of a crank clock */
    const double *speed;   /* on the bus [rad/s]; NULL on a clock in time */
    const double *angle;   /* on the bus [rad]; NULL: the clock does not steer */
    double numerator, denominator, origin; /* nominal angle of k [deg]: origin + k numerator / denominator */
    double slowest;        /* [rad/s] */
    double stop;           /* time after which it ends [s] */
    int64_t cycle;         /* steps in a cycle */
    /* state: the step being made leads from t to `next`, h long; since the instant `anchor` all steps were h long */
    double t, next, anchored;
    int64_t anchor;
};

static const double DEGREE = 3.14159265358979323846 / 180.0;

/* The nominal crank angle of an instant [deg]. */
static inline double nominal_angle(const Clock *clock, int64_t k)
{
    return clock->origin + (double)k * clock->numerator / clock->denominator;
}

/* How far the plant's angle is ahead of an instant's [rad]; both may be counted on or begin anew each turn. */
static inline double ahead(const Clock *clock, int64_t k)
{
    return remainder(*clock->angle - nominal_angle(clock, k) * DEGREE, 360.0 * DEGREE);
}

/* Makes the step from `t` to instant k h long. */
static inline void stride(Clock *clock, int64_t k, double h)
{
    if (h != clock->h) {
        clock->anchor = k - 1;
        clock->anchored = clock->t;
        clock->h = h;
    }
    clock->next = clock->anchored + (double)(k - clock->anchor) * h;
}

/* Sets the step from k-1 to k. While the speed stays the same to the last bit, t_k = anchored + (k - anchor) h; where
 * it changes, the next anchor is the instant reached. */
static int turn(Clock *clock, int64_t k)
{
    const double speed = *clock->speed, step = clock->numerator / clock->denominator * DEGREE;
    if (!(speed >= clock->slowest && speed <= 1e300)) return STALLED;
    double h = step / speed;
    if (clock->angle) {
        const double missed = ahead(clock, k - 1);
        if (!(fabs(missed) < 0.5 * step)) return ASTRAY;
        h = (step - missed) / speed;
    }
    clock->t = clock->next;
    stride(clock, k, h);
    return OK;
}

/* Whether a part that is not always stepped is stepped to instant k. */
static inline int is_due(const Clock *clock, const Part *part, int64_t k)
{
    return part->due ? part->due[k % clock->cycle] : k % part->period == 0;
}

/* The step of such a part to instant k: from where it was last stepped to. */
static inline void span(const Clock *clock, Part *part, int64_t k, double *begin, double *length)
{
    const double steps = (double)(k - part->stepped);
    if (!clock->speed) {
        *begin = clock->t0 + (double)part->stepped * clock->h;
        *length = steps * clock->h;
    } else {
        *begin = part->reached;
        *length = part->stepped >= clock->anchor ? steps * clock->h : clock->next - part->reached;
    }
    part->stepped = k;
    part->reached = clock->next;
}
