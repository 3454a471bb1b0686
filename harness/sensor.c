/* A sensor: lag, delay, gain, bias, faults, noise, drop-out, quantisation, limits, in this order. */

/* So many samples may follow a kept state; the ring of a delay has places to spare for them. */
enum { REVERSIBLE = 64 };

enum { BIAS = 0, GAIN = 1, DRIFT = 2, STUCK = 3, DROP_OUT = 4, NOISE = 5, LATE = 6 };

typedef struct {
    /* x_k = decay x_{k-1} + older u_{k-1} + newer u_k; newer = 1, the others 0, without a lag */
    int64_t lags;
    double decay, older, newer;
    /* where the steps differ in length: the time constant of the lag [s], and the step that the weights are for */
    double lag, weighted;
    /* and a delay of so long [s]: the samples lie in a ring with their times, the last one not after what is read at
     * `tail` */
    double wait;
    int64_t places, head, tail;
    double *times, *waiting;
    /* a delay of so many samples; `line` is a ring of the samples that it and the faults' delays reach, and REVERSIBLE;
     * without a delay of none */
    double delay;
    int64_t length;
    double *line;
    double gain, bias, noise, drop_out, resolution, lowest, highest;
    double edge; /* times nearer than this are one */
    int64_t early; /* faults are timed by the beginning of a step, as what a source gives is */
    int64_t plain; /* nothing but gain, bias and limits */
    Fault *faults;
    int64_t fault_count;
    /* one number a sample of each stream that is needed, NULL where it is not, drawn in blocks of `drawn`; `used` is
     * below 0 while some of the block before are left, which then lie in the REVERSIBLE places in front */
    double *normals, *uniforms;
    int64_t drawn, used;
    void (*draw_normals)(void);
    void (*draw_uniforms)(void);
    /* state, beside that of the faults; `code` is that of the fault that acts */
    int64_t next, sample, code;
    double lagged, input, reading;
    /* the state kept, and how many samples were taken since; more than REVERSIBLE where none is kept */
    int64_t since, kept_used, kept_next, kept_sample, kept_code, kept_head, kept_tail;
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

/* The weights of a lag for a step of another length; see lag_weights in sensor.py. */
static SELDOM void weigh(Sensor *s, double h)
{
    const double ratio = h / s->lag, decay = exp(-ratio), mean = -expm1(-ratio) / ratio;
    s->decay = decay;
    s->older = mean - decay;
    s->newer = 1.0 - mean;
    s->weighted = h;
}

/* The signal `wait` seconds ago, linear between samples, into `v`; ERROR where the ring has no more places. */
static int awaited(Sensor *s, double t, double *v)
{
    const double then = t - s->wait;
    const int64_t following = s->head + 1 == s->places ? 0 : s->head + 1;
    s->times[s->head] = t;
    s->waiting[s->head] = *v;
    while (s->tail != s->head) {
        const int64_t later = s->tail + 1 == s->places ? 0 : s->tail + 1;
        if (s->times[later] > then) break;
        s->tail = later;
    }
    const double early = s->waiting[s->tail], early_time = s->times[s->tail];
    *v = early;
    if (s->tail != s->head && early_time < then) {
        const int64_t later = s->tail + 1 == s->places ? 0 : s->tail + 1;
        *v = early + (then - early_time) / (s->times[later] - early_time) * (s->waiting[later] - early);
    }
    s->head = following;
    return (s->tail - following + s->places) % s->places > REVERSIBLE ? OK : ERROR;
}

/* The signal `delay` samples and the delays of the faults ago, linear between samples. A fault's delay holds what was
 * there when it began until what is late arrives: it grows by a sample a sample up to its value. */
static double delayed(Sensor *s, double v)
{
    double delay = s->delay;
    for (int64_t i = 0; i < s->fault_count; i++) {
        const Fault *fault = &s->faults[i];
        if (fault->kind == LATE && fault->acted) delay += fmin(fault->value, (double)fault->acted);
    }
    const double whole = floor(delay + 1e-9), fraction = delay - whole;
    s->line[s->next] = v;
    const int64_t now = s->next - (int64_t)whole, before = now - 1;
    const double late = s->line[now < 0 ? now + s->length : now];
    const double later = s->line[before < 0 ? before + s->length : before];
    s->next = s->next + 1 == s->length ? 0 : s->next + 1;
    return fraction < 1e-9 ? late : late + fraction * (later - late);
}

static int sensor_measure(Sensor *s, double t, double h, int64_t sample, double u, int first)
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
        if (s->lag > 0.0 && h != s->weighted && !first) weigh(s, h);
        if (!first) s->lagged = s->decay * s->lagged + s->older * s->input + s->newer * u;
        s->input = u;
        v = s->lagged;
    }
    s->code = faults_at(s->faults, s->fault_count, t, s->edge, sample);
    if (s->places && awaited(s, t, &v) != OK) return ERROR;
    if (s->length) v = delayed(s, v);
    v = v * s->gain + s->bias;

    double variance = s->noise * s->noise, kept = 1.0 - s->drop_out;
    int stuck = 0;
    for (int64_t i = 0; i < s->fault_count; i++) {
        const Fault *fault = &s->faults[i];
        if (!fault->acted) continue;
        switch (fault->kind) {
        case BIAS: v += fault->value; break;
        case GAIN: v *= fault->value; break;
        case DRIFT: v += fault->value * (t - fault->begin); break;
        case STUCK: stuck = 1; break;
        case DROP_OUT: kept *= 1.0 - fault->value; break;
        case NOISE: variance += fault->value * fault->value; break;
        default: break;
        }
    }
    if (!first && (stuck || uniform < 1.0 - kept)) return OK;

    if (variance > 0.0) v += sqrt(variance) * normal;
    if (s->resolution > 0.0) v = s->resolution * rint(v / s->resolution);
    s->reading = limited(s, v);
    return OK;
}

/* The reading, and where there are faults the code of the one that acts. */
static void sensor_tell(const Sensor *s, double *y)
{
    y[0] = s->reading;
    if (s->fault_count) y[1] = (double)s->code;
}

/* The initialised reading at t0: the signal is taken to have been u[0] for ever, and the first sample is never lost. */
EXPORT int crankbench_sensor_start(void *self, double t0, const double *u, double *y)
{
    Sensor *s = (Sensor *)self;
    s->lagged = s->input = u[0];
    for (int64_t i = 0; i < s->length; i++) s->line[i] = u[0];
    for (int64_t i = 0; i < s->fault_count; i++) s->faults[i].acted = 0;
    s->next = s->sample = s->head = s->tail = 0;
    s->weighted = 0.0;
    s->since = REVERSIBLE;
    s->plain = !s->lags && !s->length && !s->places && !s->fault_count && !s->normals && !s->uniforms && s->resolution == 0.0;
    const int status = sensor_measure(s, t0, 0.0, 0, u[0], 1);
    sensor_tell(s, y);
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
    s->sample++;
    const int status = s->early ? sensor_measure(s, t, h, s->sample - 1, u[0], 0)
                                : sensor_measure(s, t + h, h, s->sample, u[0], 0);
    sensor_tell(s, y);
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
    s->kept_sample = s->sample;
    s->kept_code = s->code;
    s->kept_head = s->head;
    s->kept_tail = s->tail;
    keep_faults(s->faults, s->fault_count);
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
    s->sample = s->kept_sample;
    s->code = s->kept_code;
    s->head = s->kept_head;
    s->tail = s->kept_tail;
    restore_faults(s->faults, s->fault_count);
    s->lagged = s->kept_lagged;
    s->input = s->kept_input;
    s->reading = s->kept_reading;
    return OK;
}
