/* Advance the continuous states: fixed-step RK4, the stiff Rosenbrock method RODAS4, located events.
 *
 * RODAS4: Hairer and Wanner, Solving Ordinary Differential Equations II, 2nd ed., section IV.10; order 4,
 * embedded order 3, L-stable and stiffly accurate, six stages, one LU factorisation a step.
 */
#include "instance.h"

#define DERIVATIVES(s, t, x, dx) model_derivatives(t, x, (s)->v + M0, (s)->v + U0, (s)->v + P0, (s)->c, dx)

static inline void rk4_step(const State *s, double t, const double *x, double h, double *x1) {
    double k1[NX + 1], k2[NX + 1], k3[NX + 1], k4[NX + 1], w[NX + 1];
    int i;
    DERIVATIVES(s, t, x, k1);
    for (i = 0; i < NX; i++) w[i] = x[i] + 0.5 * h * k1[i];
    DERIVATIVES(s, t + 0.5 * h, w, k2);
    for (i = 0; i < NX; i++) w[i] = x[i] + 0.5 * h * k2[i];
    DERIVATIVES(s, t + 0.5 * h, w, k3);
    for (i = 0; i < NX; i++) w[i] = x[i] + h * k3[i];
    DERIVATIVES(s, t + h, w, k4);
    for (i = 0; i < NX; i++) x1[i] = x[i] + h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
}

/* LU with partial pivoting, row-major; 0 where the matrix is singular. */
static int factorise(double *a, int *pivot) {
    int i, j, k;
    for (k = 0; k < NX; k++) {
        int best = k;
        for (i = k + 1; i < NX; i++)
            if (fabs(a[i * NX + k]) > fabs(a[best * NX + k])) best = i;
        pivot[k] = best;
        if (!(fabs(a[best * NX + k]) > 0)) return 0;
        if (best != k)
            for (j = 0; j < NX; j++) {
                double swap = a[k * NX + j];
                a[k * NX + j] = a[best * NX + j];
                a[best * NX + j] = swap;
            }
        for (i = k + 1; i < NX; i++) {
            double factor = a[i * NX + k] /= a[k * NX + k];
            if (factor != 0)
                for (j = k + 1; j < NX; j++) a[i * NX + j] -= factor * a[k * NX + j];
        }
    }
    return 1;
}

static void back_substitute(const double *a, const int *pivot, double *b) {
    int i, j;
    /* The factors' rows were swapped as wholes, so all swaps come before the first factor is used. */
    for (i = 0; i < NX; i++) {
        double swap = b[pivot[i]];
        b[pivot[i]] = b[i];
        b[i] = swap;
    }
    for (i = 0; i < NX; i++)
        for (j = i + 1; j < NX; j++) b[j] -= a[j * NX + i] * b[i];
    for (i = NX - 1; i >= 0; i--) {
        for (j = i + 1; j < NX; j++) b[i] -= a[i * NX + j] * b[j];
        b[i] /= a[i * NX + i];
    }
}

/* One step; the estimate of the error of x1 in `error`. 0 where the matrix is singular. */
static int rodas4_step(const State *s, double t, const double *x, double h, double *x1, double *error) {
    static const double gamma = 0.25;
    static const double a[6][5] = {
        {0},
        {1.544000000000000},
        {0.9466785280815826, 0.2557011698983284},
        {3.314825187068521, 2.896124015972201, 0.9986419139977817},
        {1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950},
        {1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950, 1.0},
    };
    static const double c[6][5] = {
        {0},
        {-5.6688},
        {-2.430093356833875, -0.2063599157091915},
        {-0.1073529058151375, -9.594562251023355, -20.47028614809616},
        {7.496443313967647, -10.24680431464352, -33.99990352819905, 11.70890893206160},
        {8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136, -6.058818238834054},
    };
    static const double nodes[6] = {0.0, 0.386, 0.21, 0.63, 1.0, 1.0};
    static const double slopes[6] = {0.25, -0.1043, 0.1035, -0.03620000000000023, 0.0, 0.0};
    double matrix[NX * NX + 1], jt[NX + 1], stages[6][NX + 1], w[NX + 1], f[NX + 1];
    int pivot[NX + 1], i, j, stage;
    model_jacobian(t, x, s->v + M0, s->v + U0, s->v + P0, s->c, matrix, jt);
    for (i = 0; i < NX * NX; i++) matrix[i] = -matrix[i];
    for (i = 0; i < NX; i++) matrix[i * NX + i] += 1.0 / (h * gamma);
    if (!factorise(matrix, pivot)) {
        for (i = 0; i < NX; i++) x1[i] = x[i], error[i] = INFINITY;
        return 0;
    }
    for (stage = 0; stage < 6; stage++) {
        double *k = stages[stage];
        for (i = 0; i < NX; i++) {
            w[i] = x[i];
            for (j = 0; j < stage; j++) w[i] += a[stage][j] * stages[j][i];
        }
        DERIVATIVES(s, t + nodes[stage] * h, w, f);
        for (i = 0; i < NX; i++) {
            k[i] = f[i] + slopes[stage] * h * jt[i];
            for (j = 0; j < stage; j++) k[i] += c[stage][j] / h * stages[j][i];
        }
        back_substitute(matrix, pivot, k);
    }
    for (i = 0; i < NX; i++) {
        x1[i] = w[i] + stages[5][i];
        error[i] = stages[5][i];
    }
    return 1;
}

static int all_finite(const double *x) {
    int i;
    for (i = 0; i < NX; i++)
        if (!isfinite(x[i])) return 0;
    return 1;
}

static double error_norm(const State *s, const double *x, const double *x1, const double *error) {
    double sum = 0, tolerance = s->v[TOLERANCE];
    int i;
    for (i = 0; i < NX; i++) {
        double scale = tolerance * (model_nominal[i] + fmax(fabs(x[i]), fabs(x1[i])));
        sum += (error[i] / scale) * (error[i] / scale);
    }
    return sqrt(sum / NX);
}

/* One step of the chosen method without error control; 0 where it has no finite result. */
static inline int plain_step(const State *s, double t, const double *x, double h, double *x1) {
    double error[NX + 1];
    if (s->v[METHOD] == RK4) {
        rk4_step(s, t, x, h, x1);
        return 1;
    }
    return rodas4_step(s, t, x, h, x1, error) && all_finite(x1);
}

/* Where in (0, h] the first indicator leaves its side: bisection on the step itself, which is then landed on.
 * Returns the step to just past the event. */
static double locate(const State *s, double t, const double *x, double h, double *x1) {
    double low = 0, high = h, w[NX + 1], z[NZ + 1];
    int i, iteration;
    for (iteration = 0; iteration < 200 && high - low > 1e-13 * fmax(h, fabs(t)) + 1e-15; iteration++) {
        double middle = low + 0.5 * (high - low);
        int crossed = 0;
        if (middle <= low || middle >= high || !plain_step(s, t, x, middle, w)) break;
        model_indicators(t + middle, w, s->v + M0, s->v + U0, s->v + P0, s->c, z);
        for (i = 0; i < NZ; i++) crossed |= s->above[i] ? z[i] < 0 : z[i] > 0;
        if (crossed)
            high = middle;
        else
            low = middle;
    }
    if (high < h) plain_step(s, t, x, high, x1);
    return high;
}

static int crossed(const State *s, double t, const double *x) {
    double z[NZ + 1];
    int i, any = 0;
    model_indicators(t, x, s->v + M0, s->v + U0, s->v + P0, s->c, z);
    for (i = 0; i < NZ; i++) any |= s->above[i] ? z[i] < 0 : z[i] > 0;
    return any;
}

enum { MAX_EVENTS = 1000, MAX_REJECTIONS = 60, MAX_STEPS = 10000000 };

static int not_finite(Instance *instance, const double *x, double t) {
    int i;
    for (i = 0; i < NX; i++)
        if (!isfinite(x[i])) return fail(instance, "'%s' is not finite at t = %.17g s", model_name[X0 + i], t);
    return fail(instance, "the step to t = %.17g s has no solution: singular matrix", t);
}

/* Integrate to `end`, handling events on the way; with stop_at_events, return at the first. */
static int integrate(Instance *instance, double end) {
    State *s = &instance->s;
    int events = 0;
    if (NX == 0) {
        s->v[0] = end;
        return OK;
    }
    while (s->v[0] < end) {
        /* Fixed steps: the span is cut into equal steps no longer than the step size. */
        const double begin = s->v[0], span = end - begin;
        const int adaptive = s->v[METHOD] == RODAS4 && s->v[TOLERANCE] > 0;
        const int whole = span <= s->v[STEP_SIZE] * (1 + 1e-9);
        const double pieces = whole ? 1 : ceil(span / s->v[STEP_SIZE] - 1e-9);
        double k = 0;
        int event = 0, rejections = 0;
        if (!adaptive && pieces > MAX_STEPS)
            return fail(instance, "%s = %g s wants more than %d steps in one communication step", model_name[STEP_SIZE],
                        s->v[STEP_SIZE], MAX_STEPS);
        while (s->v[0] < end && !event) {
            double t = s->v[0], h, x1[NX + 1], error[NX + 1], next;
            if (!adaptive) {
                next = ++k < pieces ? begin + k * (span / pieces) : end;
                h = next - t;
                if (s->v[METHOD] == RK4)
                    rk4_step(s, t, s->v + X0, h, x1);
                else if (!rodas4_step(s, t, s->v + X0, h, x1, error))
                    return not_finite(instance, x1, next);
            } else {
                double norm, factor;
                int last, solved;
                if (!(s->next_step > 0)) s->next_step = s->v[STEP_SIZE];
                last = t + s->next_step * (1 + 1e-9) >= end;
                next = last ? end : t + s->next_step;
                h = next - t;
                solved = rodas4_step(s, t, s->v + X0, h, x1, error) && all_finite(x1);
                norm = solved ? error_norm(s, s->v + X0, x1, error) : 1e9;
                factor = fmin(5.0, fmax(0.2, 0.9 * pow(fmax(norm, 1e-10), -0.25)));
                if (!(norm <= 1)) {
                    s->next_step = h * factor;
                    if (++rejections > MAX_REJECTIONS || t + s->next_step == t)
                        return fail(instance, "the step at t = %.17g s fell below %g s and still missed %s = %g", t,
                                    s->next_step, model_name[TOLERANCE], s->v[TOLERANCE]);
                    continue;
                }
                rejections = 0;
                /* A step cut short by `end` says little of how long the next may be. */
                if (!last || h * factor < s->next_step) s->next_step = h * factor;
            }
            if (!all_finite(x1)) return not_finite(instance, x1, next);
            if (NZ && crossed(s, next, x1)) {
                double located = locate(s, t, s->v + X0, h, x1);
                if (located < h) next = t + located;
                event = 1;
            }
            s->v[0] = next;
            memcpy(s->v + X0, x1, sizeof(double) * NX);
        }
        if (event) {
            if (instance->stop_at_events) {
                instance->s.event_pending = 1;
                return OK;
            }
            if (settle(s) < 0) return fail(instance, "chattering: the events at t = %.17g s never settle", s->v[0]);
            s->next_step = 0;
            if (++events > MAX_EVENTS)
                return fail(instance, "chattering: more than %d events in one communication step, at t = %.17g s",
                            MAX_EVENTS, s->v[0]);
        }
    }
    s->v[0] = end;
    return OK;
}

/* From t to t + h with held inputs: integrate from sampling instant to sampling instant. */
static int advance(Instance *instance, double t, double h) {
    State *s = &instance->s;
    const double end = t + h;
    s->v[0] = t;
    while (!instance->s.event_pending) {
        const double next = next_sample_time(s);
        const int due = sample_is_due(s, end);
        if (integrate(instance, due && next < end ? fmax(next, s->v[0]) : end)) return ERROR;
        if (instance->s.event_pending || !due) break;
        if (take_sample(instance)) return ERROR;
        if (NZ && settle(s) < 0) return fail(instance, "chattering: the events at t = %.17g s never settle", s->v[0]);
    }
    if (samples_each_step(s) && !instance->s.event_pending) {
        if (take_sample(instance)) return ERROR;
        if (NZ && settle(s) < 0) return fail(instance, "chattering: the events at t = %.17g s never settle", s->v[0]);
    }
    s->stale |= STALE_DX | STALE_Y | STALE_Z;
    instance->last_successful_time = s->v[0];
    return OK;
}
