/* A crank: angle, cycle and phases, counted along a crank clock or read off an angle that is measured. */

typedef struct {
    int64_t k, kept;       /* instants counted, now and when the state was kept */
    double numerator, denominator, origin; /* of the clock [deg], see clock.c */
    int64_t measures;      /* 1: the angle is u[0] [rad]; 0: it is counted, and u[0], where there is one, gives a residual */
    int64_t residual;      /* 1: the last output is how far u[0] is ahead of the counted angle */
    double cycle;          /* [deg] */
    int64_t cylinders;     /* 0 where no firing order is known */
    const double *tdc;     /* of each cylinder 1 ... n within the cycle [deg] */
} Crank;

/* The part of an angle within a cycle [deg], from 0 on; what misses the next cycle by a billionth of one begins it. */
static double within_cycle(double angle, double cycle)
{
    const double left = angle - cycle * floor(angle / cycle + 1e-9);
    return left > 0.0 ? left : 0.0;
}

static void crank_outputs(const Crank *crank, const double *u, double *y)
{
    const double counted = crank->origin + (double)crank->k * crank->numerator / crank->denominator;
    const double angle = crank->measures ? u[0] / DEGREE : counted;
    double nearest = INFINITY;
    *y++ = crank->measures ? u[0] : angle * DEGREE;
    *y++ = floor(angle / crank->cycle + 1e-9);
    *y++ = within_cycle(angle, crank->cycle) * DEGREE;
    if (crank->cylinders) {
        double *last = y++;
        for (int64_t i = 0; i < crank->cylinders; i++) {
            const double phase = within_cycle(angle - crank->tdc[i], crank->cycle);
            if (phase < nearest) {
                nearest = phase;
                *last = (double)(i + 1);
            }
            *y++ = phase * DEGREE;
        }
    }
    if (crank->residual) *y = remainder(u[0] - counted * DEGREE, 360.0 * DEGREE);
}

EXPORT int crankbench_crank_start(void *self, double t, const double *u, double *y)
{
    (void)t;
    ((Crank *)self)->k = 0;
    crank_outputs((Crank *)self, u, y);
    return OK;
}

EXPORT int crankbench_crank_step(void *self, double t, double h, const double *u, double *y)
{
    Crank *crank = (Crank *)self;
    (void)t;
    (void)h;
    crank->k++;
    crank_outputs(crank, u, y);
    return OK;
}

EXPORT int crankbench_crank_keep(void *self)
{
    ((Crank *)self)->kept = ((Crank *)self)->k;
    return OK;
}

EXPORT int crankbench_crank_restore(void *self)
{
    ((Crank *)self)->k = ((Crank *)self)->kept;
    return OK;
}
