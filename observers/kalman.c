/* The linear-Gaussian steps of observers/kalman.py over matrices of fixed size, row-major.
 *
 * Before it stand: N, the states estimated, which are the first of NX; M, the measurements; K, the states whose joint
 * covariance is shown, `shown`; where in the discrete states m and the parameters p things are, AT_..., with a filter's
 * own parameters AT_MORE; where the measurements begin in the inputs u, MEASURED.
 *
 * Covariances are in units of the nominal values, so that the states are of one size.
 */
enum { TRANSITION_TERMS = 14, NOISE_TERMS = 17, MOST_HALVINGS = 60 };
static const double kalman_piece = 0.5, kalman_negligible = 1e-13;

/* c = a b, where zeros of a cost nothing. */
static void multiply(const double *a, const double *b, double *c) {
    int i, j, k;
    for (i = 0; i < N; i++) {
        double *row = c + i * N;
        for (j = 0; j < N; j++) row[j] = 0;
        for (k = 0; k < N; k++) {
            const double factor = a[i * N + k];
            if (factor != 0)
                for (j = 0; j < N; j++) row[j] += factor * b[k * N + j];
        }
    }
}

/* c = a b a' for a symmetric b; exactly symmetric. */
static void congruence(const double *a, const double *b, double *c) {
    double half[N * N];
    int i, j, k;
    multiply(a, b, half);
    for (i = 0; i < N; i++)
        for (j = 0; j <= i; j++) {
            double sum = 0;
            for (k = 0; k < N; k++) sum += half[i * N + k] * a[j * N + k];
            c[i * N + j] = c[j * N + i] = sum;
        }
}

/* Phi and Q of x' = A x + w over h, w of spectral density diag(density): `discretise`. */
static void discretise(const double *A, const double *density, double h, double *Phi, double *Q) {
    double term[N * N], half[N * N], norm = 0;
    int i, j, k, halvings = 0;
    for (i = 0; i < N; i++) {
        double sum = 0;
        for (j = 0; j < N; j++) sum += fabs(A[i * N + j]);
        norm = fmax(norm, sum);
    }
    while (norm * h > kalman_piece && halvings < MOST_HALVINGS) h *= 0.5, halvings++;
    for (i = 0; i < N * N; i++) Phi[i] = term[i] = 0;
    for (i = 0; i < N; i++) Phi[i * N + i] = term[i * N + i] = 1;
    for (k = 1; k <= TRANSITION_TERMS; k++) {
        multiply(A, term, half);
        for (i = 0; i < N * N; i++) Phi[i] += term[i] = half[i] * (h / k);
    }
    for (i = 0; i < N * N; i++) Q[i] = term[i] = 0;
    for (i = 0; i < N; i++) Q[i * N + i] = term[i * N + i] = density[i] * h;
    for (k = 1; k <= NOISE_TERMS; k++) {
        multiply(A, term, half);
        for (i = 0; i < N; i++)
            for (j = 0; j < N; j++) term[i * N + j] = (half[i * N + j] + half[j * N + i]) * (h / (k + 1));
        for (i = 0; i < N * N; i++) Q[i] += term[i];
    }
    for (; halvings > 0; halvings--) {
        congruence(Phi, Q, half);
        for (i = 0; i < N * N; i++) Q[i] += half[i];
        multiply(Phi, Phi, half);
        memcpy(Phi, half, sizeof half);
    }
}

/* Phi and Q of the model over h, A the mean of the Jacobians at the two ends of the interval: `interval`. */
static void model_interval(const State *s, const double *before, double h, double *Phi, double *Q) {
    double first[NX * NX], last[NX * NX], unused[NX], start[NX], A[N * N], density[N];
    const double *scale = model_nominal, *p = s->v + P0;
    int i, j;
    memcpy(start, s->v + X0, sizeof start);
    memcpy(start, before, sizeof(double) * N);
    model_jacobian(s->v[0] - h, start, s->v + M0, s->v + U0, p, s->c, first, unused);
    model_jacobian(s->v[0], s->v + X0, s->v + M0, s->v + U0, p, s->c, last, unused);
    for (i = 0; i < N; i++) {
        const double strays = p[AT_PROCESS + i] / scale[i];
        density[i] = strays * strays;
        for (j = 0; j < N; j++) A[i * N + j] = 0.5 * (first[i * NX + j] + last[i * NX + j]) * scale[j] / scale[i];
    }
    discretise(A, density, h, Phi, Q);
}

/* S = L L'; -1, or the number of the measurement at which S is singular. */
static int innovation_root(const double *S, double *L) {
    int i, j, k;
    for (i = 0; i < M * M; i++) L[i] = 0;
    for (j = 0; j < M; j++) {
        double pivot = S[j * M + j];
        for (k = 0; k < j; k++) pivot -= L[j * M + k] * L[j * M + k];
        if (!(pivot > kalman_negligible * S[j * M + j])) return j;
        L[j * M + j] = sqrt(pivot);
        for (i = j + 1; i < M; i++) {
            double rest = S[i * M + j];
            for (k = 0; k < j; k++) rest -= L[i * M + k] * L[j * M + k];
            L[i * M + j] = rest / L[j * M + j];
        }
    }
    return -1;
}

/* gain (N, M) = cross S^-1. */
static void solve_gain(const double *L, const double *cross, double *gain) {
    int i, j, k;
    for (i = 0; i < N; i++) {
        double *row = gain + i * M;
        for (j = 0; j < M; j++) {
            row[j] = cross[i * M + j];
            for (k = 0; k < j; k++) row[j] -= L[j * M + k] * row[k];
            row[j] /= L[j * M + j];
        }
        for (j = M - 1; j >= 0; j--) {
            for (k = j + 1; k < M; k++) row[j] -= L[k * M + j] * row[k];
            row[j] /= L[j * M + j];
        }
    }
}

/* S = L L', or an error that names the measurement at fault. */
static int require_root(Instance *instance, const double *v, const double *S, double *L) {
    int i, row;
    for (i = 0; i < M; i++)
        if (!isfinite(v[i]) || !isfinite(S[i * M + i]))
            return fail(instance, "'%s' less what is expected of it is %g at t = %.9g s, of the variance %g",
                        model_name[U0 + MEASURED + i], v[i], instance->s.v[0], S[i * M + i]);
    row = innovation_root(S, L);
    if (row < 0) return OK;
    return fail(instance,
                "the innovation covariance is singular at t = %.9g s: what '%s' shows is known without it; "
                "give its sensor a noise",
                instance->s.v[0], model_name[U0 + MEASURED + row]);
}

/* All that is told of a sampling: x and P after the correction, the innovation v (M), its covariance S = L L'. */
static void tell(const State *s, const double *x, const double *P, const double *v, const double *S, const double *L,
                 double *mn) {
    const double *scale = model_nominal;
    double whitened[M], squared = 0;
    int i, j;
    memcpy(mn + AT_COVARIANCE, P, sizeof(double) * N * N);
    memcpy(mn + AT_BEFORE, x, sizeof(double) * N);
    for (i = 0; i < M; i++) {
        whitened[i] = v[i];
        for (j = 0; j < i; j++) whitened[i] -= L[i * M + j] * whitened[j];
        whitened[i] /= L[i * M + i];
        squared += whitened[i] * whitened[i];
        mn[AT_INNOVATION + i] = v[i];
    }
    mn[AT_NIS] = squared;
    memcpy(mn + AT_INNOVATION_COVARIANCE, S, sizeof(double) * M * M);
    for (i = 0; i < STD; i++) mn[AT_STD + i] = sqrt(P[i * N + i]) * scale[i];
    for (i = 0; i < K; i++)
        for (j = 0; j < K; j++)
            mn[AT_SHOWN + i * K + j] = P[shown[i] * N + shown[j]] * scale[shown[i]] * scale[shown[j]];
}

/* How long the interval is that ends now. */
static double interval_length(const State *s) {
#if NX > N
    return s->v[X0 + N];
#else
    return s->v[SAMPLE_TIME];
#endif
}

/* x+ where nothing is estimated: the time since the last sampling begins anew. */
static void begin_anew(double *xn) {
    int i;
    for (i = N; i < NX; i++) xn[i] = 0;
}
