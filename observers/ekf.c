/* The extended Kalman filter's sampling: observers/ekf.py. */
static int kernel_sample(Instance *instance, double *xn, double *mn) {
    State *s = &instance->s;
    const double *m = s->v + M0, *p = s->v + P0, *scale = model_nominal;
    double Phi[N * N], Q[N * N], P[N * N], kept[N * N], expected[M], C[M * NX], scaled[M * N], cross[N * M], S[M * M],
        L[M * M], gain[N * M], v[M];
    int i, j, k;
    memcpy(mn, m, sizeof(double) * NM);
    model_interval(s, m + AT_BEFORE, interval_length(s), Phi, Q);
    congruence(Phi, m + AT_COVARIANCE, P);
    for (i = 0; i < N * N; i++) P[i] += Q[i];

    model_expected(s->v[0], s->v + X0, m, s->v + U0, p, s->c, expected);
    model_expected_jacobian(s->v[0], s->v + X0, m, s->v + U0, p, s->c, C);
    for (i = 0; i < M; i++) {
        v[i] = s->v[U0 + MEASURED + i] - expected[i];
        for (j = 0; j < N; j++) scaled[i * N + j] = C[i * NX + j] * scale[j];
    }
    for (i = 0; i < N; i++)
        for (j = 0; j < M; j++) {
            double sum = 0;
            for (k = 0; k < N; k++) sum += P[i * N + k] * scaled[j * N + k];
            cross[i * M + j] = sum;
        }
    for (i = 0; i < M; i++)
        for (j = 0; j <= i; j++) {
            double sum = i == j ? p[AT_NOISE + i] * p[AT_NOISE + i] : 0;
            for (k = 0; k < N; k++) sum += scaled[i * N + k] * cross[k * M + j];
            S[i * M + j] = S[j * M + i] = sum;
        }
    if (require_root(instance, v, S, L)) return ERROR;
    solve_gain(L, cross, gain);

    memcpy(xn, s->v + X0, sizeof(double) * NX);
    for (i = 0; i < N; i++) {
        double moved = 0;
        for (j = 0; j < M; j++) moved += gain[i * M + j] * v[j];
        xn[i] += moved * scale[i];
        for (j = 0; j < N; j++) {
            kept[i * N + j] = i == j;
            for (k = 0; k < M; k++) kept[i * N + j] -= gain[i * M + k] * scaled[k * N + j];
        }
    }
    congruence(kept, P, Q);
    for (i = 0; i < N; i++)
        for (j = 0; j <= i; j++) {
            double sum = Q[i * N + j];
            for (k = 0; k < M; k++) sum += gain[i * M + k] * gain[j * M + k] * p[AT_NOISE + k] * p[AT_NOISE + k];
            P[i * N + j] = P[j * N + i] = sum;
        }
    tell(s, xn, P, v, S, L, mn);
    begin_anew(xn);
    return OK;
}
