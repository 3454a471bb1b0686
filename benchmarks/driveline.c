/* The driveline written by hand: fixed-step RK4, crossings of the two angles located by bisection, nothing general. */
#include <math.h>

#define EXPORT __attribute__((visibility("default")))
#define RPM (30.0 / 3.14159265358979323846)

typedef struct {
    double tau, J_e, J_v, B_e, b_sm, k, k_1, theta_e0, theta_1;
    double theta_e, omega_c, omega_p;
    int location;
} Driveline;

static inline double at_equilibrium(const Driveline *d) {
    return d->k * d->theta_e0 +
           (d->k_1 - d->k) * (fmax(d->theta_e0 - d->theta_1, 0.0) + fmin(d->theta_e0 + d->theta_1, 0.0));
}

static inline void derivatives(const Driveline *d, double torque_in, double equilibrium, const double *x, double *dx) {
    const double theta = x[0] + d->theta_e0, beyond = (d->k_1 - d->k) * d->theta_1;
    const double slip = d->tau * x[1] - x[2];
    const double elastic = d->location == 1   ? d->k_1 * theta + beyond
                           : d->location == 2 ? d->k * theta
                                              : d->k_1 * theta - beyond;
    const double torque = elastic - equilibrium + d->b_sm * slip;
    dx[0] = slip;
    dx[1] = (torque_in - d->B_e * x[1] - d->tau * torque) / d->J_e;
    dx[2] = torque / d->J_v;
}

static inline void rk4(const Driveline *d, double u, double equilibrium, const double *x, double h, double *x1) {
    double k1[3], k2[3], k3[3], k4[3], w[3];
    derivatives(d, u, equilibrium, x, k1);
    for (int i = 0; i < 3; i++) w[i] = x[i] + 0.5 * h * k1[i];
    derivatives(d, u, equilibrium, w, k2);
    for (int i = 0; i < 3; i++) w[i] = x[i] + 0.5 * h * k2[i];
    derivatives(d, u, equilibrium, w, k3);
    for (int i = 0; i < 3; i++) w[i] = x[i] + h * k3[i];
    derivatives(d, u, equilibrium, w, k4);
    for (int i = 0; i < 3; i++) x1[i] = x[i] + h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
}

static inline int location_of(const Driveline *d, const double *x) {
    const double theta = x[0] + d->theta_e0;
    return 1 + (theta + d->theta_1 > 0) + (theta - d->theta_1 > 0);
}

EXPORT int driveline_step(void *self, double t, double h, const double *u, double *y) {
    Driveline *d = self;
    const double equilibrium = at_equilibrium(d);
    double x[3] = {d->theta_e, d->omega_c, d->omega_p}, x1[3];
    double left = h;
    for (;;) {
        rk4(d, u[0], equilibrium, x, left, x1);
        if (location_of(d, x1) == d->location) break;
        double low = 0, high = left, w[3];
        while (high - low > 1e-13 * fmax(left, fabs(t)) + 1e-15) {
            const double middle = low + 0.5 * (high - low);
            rk4(d, u[0], equilibrium, x, middle, w);
            if (location_of(d, w) == d->location)
                low = middle;
            else
                high = middle;
        }
        rk4(d, u[0], equilibrium, x, high, x1);
        d->location = location_of(d, x1);
        left -= high;
        if (!(left > 0)) break;
        x[0] = x1[0], x[1] = x1[1], x[2] = x1[2];
    }
    y[0] = d->theta_e = x1[0];
    y[1] = d->omega_c = x1[1];
    y[2] = d->omega_p = x1[2];
    y[3] = RPM * x1[1];
    y[4] = d->location;
    return 0;
}
