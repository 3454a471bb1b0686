/* Bare loops, the peers of the platform's own: FMUs called through nothing, in a fixed order, with fixed places. */
#include <stddef.h>
#include <stdint.h>

#define EXPORT __attribute__((visibility("default")))

typedef struct {
    void *instance;
    int (*set_real)(void *, const uint32_t *, size_t, const double *);
    int (*do_step)(void *, double, double, int);
    int (*get_real)(void *, const uint32_t *, size_t, double *);
    int (*get_integer)(void *, const uint32_t *, size_t, int *);
    const uint32_t *inputs, *outputs, *integers;
    size_t n_inputs, n_outputs, n_integers;
} Fmu;

typedef int (*Step)(void *self, double t, double h, const double *u, double *y);

/* A row: theta_e, omega_c, omega_p, y in rpm, location. */
EXPORT int step_driveline_fmu(const Fmu *plant, int64_t steps, double h, const double *torque, double *rows) {
    for (int64_t k = 0; k < steps; k++, rows += 5) {
        int location, status = plant->set_real(plant->instance, plant->inputs, 1, &torque[k]);
        status |= plant->do_step(plant->instance, (double)k * h, h, 1);
        status |= plant->get_real(plant->instance, plant->outputs, 4, rows);
        status |= plant->get_integer(plant->instance, plant->integers, 1, &location);
        if (status) return status;
        rows[4] = location;
    }
    return 0;
}

EXPORT int step_driveline_c(Step step, void *self, int64_t steps, double h, const double *torque, double *rows) {
    for (int64_t k = 0; k < steps; k++, rows += 5) {
        int status = step(self, (double)k * h, h, &torque[k], rows);
        if (status) return status;
    }
    return 0;
}

/* Source, plant, sensor of y, observer. A row: torque, theta_e, omega_c, omega_p, y in rad/s, location, the sensor's
 * value, the observer's three estimates and its location. Source and sensor are the platform's own step functions. */
EXPORT int run_bare(const Fmu *plant, const Fmu *observer, Step source, void *source_self, Step sensor,
                    void *sensor_self, int64_t steps, double h, double rpm, double *rows) {
    for (int64_t k = 0; k < steps; k++) {
        const double t = (double)k * h;
        double *row = rows + 12 * k, measured[2];
        int location, status;
        *row++ = (double)(k + 1) * h;
        status = source(source_self, t, h, NULL, row);
        status |= plant->set_real(plant->instance, plant->inputs, 1, row);
        status |= plant->do_step(plant->instance, t, h, 1);
        status |= plant->get_real(plant->instance, plant->outputs, 4, row + 1);
        status |= plant->get_integer(plant->instance, plant->integers, 1, &location);
        row[4] = rpm * row[4];
        row[5] = location;
        status |= sensor(sensor_self, t, h, row + 4, row + 6);
        measured[0] = row[6] / rpm;
        measured[1] = row[0];
        status |= observer->set_real(observer->instance, observer->inputs, 2, measured);
        status |= observer->do_step(observer->instance, t, h, 1);
        status |= observer->get_real(observer->instance, observer->outputs, 3, row + 7);
        status |= observer->get_integer(observer->instance, observer->integers, 1, &location);
        row[10] = location;
        if (status) return status;
    }
    return 0;
}
