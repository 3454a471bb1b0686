/* The unscented Kalman filter's sampling: observers/ukf.py.
 *
 * The mean has come to the end of the interval as the model's own state; the other points are brought there by the same
 * solver, each from its own beginning.
 */
enum { POINTS = 2 * N };

/* P = L L' for a positive semidefinite P: a pivot that is zero but for rounding has a column of zeros.
 * -1, or the number of the state at which P is not. */
static int covariance_root(const double *P, double *L) {
    int i, j, k;
    for (i = 0; i < N * N; i++) L[i] = 0;
    for (j = 0; j < N; j++) {
        double pivot = P[j * N + j];
        const double rounding = kalman_negligible * P[j * N + j];
        for (k = 0; k < j; k++) pivot -= L[j * N + k] * L[j * N + k];
        if (!(pivot >= -rounding)) return j;
        if (pivot <= rounding) continue;
        L[j * N + j] = sqrt(pivot);
        for (i = j + 1; i < N; i++) {
            double rest = P[i * N + j];
            for (k = 0; k < j; k++) rest -= L[i * N + k] * L[j * N + k];
            L[i * N + j] = rest / L[j * N + j];
        }
    }
    return -1;
}

/* offsets (POINTS, N) from the mean: spread times plus, then minus the columns of the root. */
static int spread_points(Instance *instance, const double *P, double spread, double *offsets) {
    double L[N * N];
    int i, j, state = covariance_root(P, L);
    if (state >= 0)
        return fail(instance, "the covariance is not positive semidefinite at t = %.9g s, at the state '%s'",
                    instance->s.v[0], model_name[X0 + state]);
    for (j = 0; j < N; j++)
        for (i = 0; i < N; i++) {
            offsets[j * N + i] = spread * L[i * N + j];
            offsets[(N + j) * N + i] = -spread * L[i * N + j];
        }
    return OK;
}

/* Mean of the offsets (POINTS, size) with weight w each. */
static void mean_offset(const double *offsets, int size, double w, double *mean) {
    int i, k;
    for (i = 0; i < size; i++) {
        mean[i] = 0;
        for (k = 0; k < POINTS; k++) mean[i] += w * offsets[k * size + i];
    }
}

static int kernel_sample(Instance *instance, double *xn, double *mn) {
    State *s = &instance->s;
    const double *m = s->v + M0, *p = s->v + P0, *scale = model_nominal;
    const double h = interval_length(s), spread = p[AT_MORE], w = 0.5 / (spread * spread), now = s->v[0];
    double Phi[N * N], Q[N * N], P[N * N], L[M * M], cross[N * M], S[M * M], gain[N * M], v[M], shift[N], expected[M],
        bias[M], point[NX];
    double offsets[POINTS * N], seen[POINTS * M];
    Instance one;
    int i, j, k;
    memcpy(mn, m, sizeof(double) * NM);
    model_interval(s, m + AT_BEFORE, h, Phi, Q);

    if (spread_points(instance, m + AT_COVARIANCE, spread, offsets)) return ERROR;
    for (k = 0; k < POINTS; k++) {
        one = *instance;
        one.s.v[0] = now - h;
        one.stop_at_events = 0;
        for (i = 0; i < N; i++) one.s.v[X0 + i] = m[AT_BEFORE + i] + scale[i] * offsets[k * N + i];
        for (i = N; i < NX; i++) one.s.v[X0 + i] = 0;
        if (NZ && settle(&one.s) < 0) return fail(instance, "the events of a sigma point never settle");
        if (integrate(&one, now))
            return fail(instance, "the sigma point that is off by %g in '%s' could not be brought to t = %.9g s",
                        scale[k % N] * offsets[k * N + k % N], model_name[X0 + k % N], now);
        for (i = 0; i < N; i++) offsets[k * N + i] = (one.s.v[X0 + i] - s->v[X0 + i]) / scale[i];
    }
    mean_offset(offsets, N, w, shift);
    memcpy(xn, s->v + X0, sizeof(double) * NX);
    for (i = 0; i < N; i++) {
        xn[i] += scale[i] * shift[i];
        for (j = 0; j <= i; j++) {
            double sum = Q[i * N + j];
            for (k = 0; k < POINTS; k++) sum += w * offsets[k * N + i] * offsets[k * N + j];
            P[i * N + j] = P[j * N + i] = sum;
        }
    }

    if (spread_points(instance, P, spread, offsets)) return ERROR;
    model_expected(now, xn, m, s->v + U0, p, s->c, expected);
    memcpy(point, xn, sizeof point);
    for (k = 0; k < POINTS; k++) {
        for (i = 0; i < N; i++) point[i] = xn[i] + scale[i] * offsets[k * N + i];
        model_expected(now, point, m, s->v + U0, p, s->c, seen + k * M);
        for (i = 0; i < M; i++) seen[k * M + i] -= expected[i];
    }
    mean_offset(seen, M, w, bias);
    for (i = 0; i < M; i++) {
        v[i] = s->v[U0 + MEASURED + i] - expected[i] - bias[i];
        for (j = 0; j <= i; j++) {
            double sum = i == j ? p[AT_NOISE + i] * p[AT_NOISE + i] : 0;
            for (k = 0; k < POINTS; k++) sum += w * seen[k * M + i] * seen[k * M + j];
            S[i * M + j] = S[j * M + i] = sum;
        }
        for (j = 0; j < N; j++) {
            double sum = 0;
            for (k = 0; k < POINTS; k++) sum += w * offsets[k * N + j] * seen[k * M + i];
            cross[j * M + i] = sum;
        }
    }
    if (require_root(instance, v, S, L)) return ERROR;
    solve_gain(L, cross, gain);
    for (k = 0; k < POINTS; k++)
        for (i = 0; i < N; i++)
            for (j = 0; j < M; j++) offsets[k * N + i] -= gain[i * M + j] * seen[k * M + j];
    for (i = 0; i < N; i++) {
        double moved = 0;
        for (j = 0; j < M; j++) moved += gain[i * M + j] * v[j];
        xn[i] += moved * scale[i];
        for (j = 0; j <= i; j++) {
            double sum = 0;
            for (k = 0; k < POINTS; k++) sum += w * offsets[k * N + i] * offsets[k * N + j];
            for (k = 0; k < M; k++) sum += gain[i * M + k] * gain[j * M + k] * p[AT_NOISE + k] * p[AT_NOISE + k];
            P[i * N + j] = P[j * N + i] = sum;
        }
    }
    tell(s, xn, P, v, S, L, mn);
    begin_anew(xn);
    return OK;
}
