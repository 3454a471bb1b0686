/* A sensor: lag, delay, gain, bias, faults, noise, drop-out, quantisation, limits, in this order. */
#include <math.h>
#include <stdint.h>

/* So many samples may follow a kept state; the ring of a delay has places to spare for them. */
enum { REVERSIBLE = 64 };

enum { BIAS = 0, GAIN = 1, DRIFT = 2, STUCK = 3, DROP_OUT = 4, NOISE = 5 };

typedef struct {
    int64_t kind;
    double value, from, until; /* active for from <= t < until */
} Fault;

typedef struct {
    /* x_k = decay x_{k-1} + older u_{k-1} + newer u_k; newer = 1, the others 0, without a lag */
    int64_t lags;
    double decay, older, newer;
    /* a delay of (whole + fraction) samples; `line` is a ring of whole + 2 + REVERSIBLE samples,
     * without a delay of none */
    int64_t length, whole;
    double fraction;
    double *line;
    double gain, bias, noise, drop_out, resolution, lowest, highest;
    double edge; /* times nearer than this are one */
    int64_t plain; /* nothing but gain, bias and limits */
    const Fault *faults;
    int64_t fault_count;
    /* one number a sample of each stream that is needed, NULL where it is not, drawn in blocks of `drawn`; `used` is
     * below 0 while some of the block before are left, which then lie in the REVERSIBLE places in front */
    double *normals, *uniforms;
    int64_t drawn, used;
    void (*draw_normals)(void);
    void (*draw_uniforms)(void);
    /* state */
    int64_t next;
    double lagged, input, reading;
    /* the state kept, and how many samples were taken since; more than REVERSIBLE where none is kept */
    int64_t since, kept_used, kept_next;
    double kept_lagged, kept_input, kept_reading;
} Sensor;

/* Fills a block of random numbers; FATAL where nothing was drawn. */
static int sensor_draw(double *block, void (*draw)(void))
{
    if (!block) return OK;
    block[0] = NAN;
    draw();
    return isnan(block[0]) ? FATAL : OK;
}

static inline double limited(const Sensor *s, double v)
{
    return v < s->lowest ? s->lowest : v > s->highest ? s->highest : v;
}

static int sensor_measure(Sensor *s, double t, double u, int first)
{
    double normal = 0.0, uniform = 1.0;
    if (s->used == s->drawn) {
        if (sensor_draw(s->normals, s->draw_normals) || sensor_draw(s->uniforms, s->draw_uniforms)) return FATAL;
        s->used = 0;
    }
    if (s->normals) normal = s->normals[s->used];
    if (s->uniforms) uniform = s->uniforms[s->used];
    s->used++;
    s->since++;

    double v = u;
    if (s->lags) {
        if (!first) s->lagged = s->decay * s->lagged + s->older * s->input + s->newer * u;
        s->input = u;
        v = s->lagged;
    }
    if (s->length) {
        s->line[s->next] = v;
        const int64_t now = s->next - s->whole, before = now - 1;
        const double late = s->line[now < 0 ? now + s->length : now];
        const double later = s->line[before < 0 ? before + s->length : before];
        v = s->fraction == 0.0 ? late : late + s->fraction * (later - late);
        s->next = s->next + 1 == s->length ? 0 : s->next + 1;
    }
    v = v * s->gain + s->bias;

    double variance = s->noise * s->noise, kept = 1.0 - s->drop_out;
    int stuck = 0;
    for (int64_t i = 0; i < s->fault_count; i++) {
        const Fault *fault = &s->faults[i];
        if (t < fault->from - s->edge || t >= fault->until - s->edge) continue;
        switch (fault->kind) {
        case BIAS: v += fault->value; break;
        case GAIN: v *= fault->value; break;
        case DRIFT: v += fault->value * (t - fault->from); break;
        case STUCK: stuck = 1; break;
        case DROP_OUT: kept *= 1.0 - fault->value; break;
        default: variance += fault->value * fault->value; break;
        }
    }
    if (!first && (stuck || uniform < 1.0 - kept)) return OK;

    if (variance > 0.0) v += sqrt(variance) * normal;
    if (s->resolution > 0.0) v = s->resolution * rint(v / s->resolution);
    s->reading = limited(s, v);
    return OK;
}

/* The initialised reading at t0: the signal is taken to have been u[0] for ever, and the first sample is never lost. */
EXPORT int crankbench_sensor_start(void *self, double t0, const double *u, double *y)
{
    Sensor *s = (Sensor *)self;
    s->lagged = s->input = u[0];
    for (int64_t i = 0; i < s->length; i++) s->line[i] = u[0];
    s->next = 0;
    s->since = REVERSIBLE;
    s->plain = !s->lags && !s->length && !s->fault_count && !s->normals && !s->uniforms && s->resolution == 0.0;
    const int status = sensor_measure(s, t0, u[0], 1);
    y[0] = s->reading;
    return status;
}

/* The reading at t + h of a signal that is u[0] there. */
EXPORT int crankbench_sensor_step(void *self, double t, double h, const double *u, double *y)
{
    Sensor *s = (Sensor *)self;
    if (s->plain) {
        y[0] = limited(s, u[0] * s->gain + s->bias);
        return OK;
    }
    const int status = sensor_measure(s, t + h, u[0], 0);
    y[0] = s->reading;
    return status;
}

/* Moves the numbers left of a block in front of it and draws the next one. */
static void sensor_move_left(double *block, int64_t left, int64_t drawn)
{
    if (!block) return;
    for (int64_t i = 0; i < left; i++) block[i - left] = block[drawn - left + i];
}

/* Remembers the state. No block of numbers ends within the samples that may follow, so that going back needs none of
 * the block before. */
EXPORT int crankbench_sensor_keep(void *self)
{
    Sensor *s = (Sensor *)self;
    const int64_t left = s->drawn - s->used;
    if (left < REVERSIBLE) {
        sensor_move_left(s->normals, left, s->drawn);
        sensor_move_left(s->uniforms, left, s->drawn);
        if (sensor_draw(s->normals, s->draw_normals) || sensor_draw(s->uniforms, s->draw_uniforms)) return FATAL;
        s->used = -left;
    }
    s->since = 0;
    s->kept_used = s->used;
    s->kept_next = s->next;
    s->kept_lagged = s->lagged;
    s->kept_input = s->input;
    s->kept_reading = s->reading;
    return OK;
}

/* Goes back to it; ERROR where none is kept or too many samples were taken since. */
EXPORT int crankbench_sensor_restore(void *self)
{
    Sensor *s = (Sensor *)self;
    if (s->since > REVERSIBLE) return ERROR;
    s->since = 0;
    s->used = s->kept_used;
    s->next = s->kept_next;
    s->lagged = s->kept_lagged;
    s->input = s->kept_input;
    s->reading = s->kept_reading;
    return OK;
}
