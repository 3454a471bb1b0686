/* Two signals that change places while a window is open. */

typedef struct {
    Window window;
    double edge;
    int64_t early; /* the signals are those of the beginning of a step, as a source's are */
    int64_t code;
    int64_t sample, kept_sample; /* state, and the state kept */
} Swap;

static int swap_pass(const Swap *s, double t, int64_t sample, const double *u, double *y)
{
    const int crossed = is_open(&s->window, t, s->edge, sample);
    const double first = u[0], second = u[1];
    y[0] = crossed ? second : first;
    y[1] = crossed ? first : second;
    y[2] = crossed ? (double)s->code : 0.0;
    return OK;
}

EXPORT int crankbench_swap_start(void *self, double t0, const double *u, double *y)
{
    Swap *s = (Swap *)self;
    s->sample = 0;
    return swap_pass(s, t0, 0, u, y);
}

EXPORT int crankbench_swap_step(void *self, double t, double h, const double *u, double *y)
{
    Swap *s = (Swap *)self;
    s->sample++;
    return s->early ? swap_pass(s, t, s->sample - 1, u, y) : swap_pass(s, t + h, s->sample, u, y);
}

EXPORT int crankbench_swap_keep(void *self)
{
    Swap *s = (Swap *)self;
    s->kept_sample = s->sample;
    return OK;
}

EXPORT int crankbench_swap_restore(void *self)
{
    Swap *s = (Swap *)self;
    s->sample = s->kept_sample;
    return OK;
}
