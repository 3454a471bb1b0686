/* Bare loops, the peers of the platform's own: FMUs called through nothing, in a fixed order, with fixed places. */
#include <stddef.h>
#include <stdint.h>

#define EXPORT __attribute__((visibility("default")))

typedef struct {
    void *instance;
    int (*do_step)(void *, double, double, int);
    int (*set_real)(void *, const uint32_t *, size_t, const double *);
    int (*set_integer)(void *, const uint32_t *, size_t, const int *);
    int (*set_boolean)(void *, const uint32_t *, size_t, const int *);
    int (*get_real)(void *, const uint32_t *, size_t, double *);
    int (*get_integer)(void *, const uint32_t *, size_t, int *);
    int (*get_boolean)(void *, const uint32_t *, size_t, int *);
    const uint32_t *reals_in, *integers_in, *booleans_in, *reals, *integers, *booleans;
    size_t n_reals_in, n_integers_in, n_booleans_in, n_reals, n_integers, n_booleans;
} Fmu;

typedef int (*Step)(void *self, double t, double h, const double *u, double *y);

/* The platform's own step functions of the source and the sensor, whose work is not the loop's. */
typedef struct {
    Step step;
    void *self;
} Native;

/* A row: theta_e, omega_c, omega_p, y in rpm, location. */
EXPORT int step_driveline_fmu(const Fmu *plant, int64_t steps, double h, const double *torque, double *rows) {
    for (int64_t k = 0; k < steps; k++, rows += 5) {
        int location, status = plant->set_real(plant->instance, plant->reals_in, 1, &torque[k]);
        status |= plant->do_step(plant->instance, (double)k * h, h, 1);
        status |= plant->get_real(plant->instance, plant->reals, 4, rows);
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

/* Rows of the loops below begin with the time, as ours do. */

/* Source, plant, sensor of y, observer. A row: time, torque, theta_e, omega_c, omega_p, y in rad/s, location, the sensor's
 * value, the observer's three estimates and its location. */
EXPORT int run_driveline(const Fmu *fmus, const Native *natives, int64_t steps, double h, double rpm, double *rows) {
    const Fmu plant = fmus[0], observer = fmus[1];
    const Native source = natives[0], sensor = natives[1];
    for (int64_t k = 0; k < steps; k++, rows += 12) {
        const double t = (double)k * h;
        double *row = rows + 1, measured[2];
        rows[0] = (double)(k + 1) * h;
        int location, status = source.step(source.self, t, h, NULL, row);
        status |= plant.set_real(plant.instance, plant.reals_in, 1, row);
        status |= plant.do_step(plant.instance, t, h, 1);
        status |= plant.get_real(plant.instance, plant.reals, 4, row + 1);
        status |= plant.get_integer(plant.instance, plant.integers, 1, &location);
        row[4] = rpm * row[4];
        row[5] = location;
        status |= sensor.step(sensor.self, t, h, row + 4, row + 6);
        measured[0] = row[6] / rpm;
        measured[1] = row[0];
        status |= observer.set_real(observer.instance, observer.reals_in, 2, measured);
        status |= observer.do_step(observer.instance, t, h, 1);
        status |= observer.get_real(observer.instance, observer.reals, 3, row + 7);
        status |= observer.get_integer(observer.instance, observer.integers, 1, &location);
        row[10] = location;
        if (status) return status;
    }
    return 0;
}

/* The Van der Pol oscillator alone. A row: time and its two outputs. */
EXPORT int run_oscillator(const Fmu *fmus, const Native *natives, int64_t steps, double h, double rpm, double *rows) {
    const Fmu oscillator = fmus[0];
    (void)natives;
    (void)rpm;
    for (int64_t k = 0; k < steps; k++, rows += 3) {
        rows[0] = (double)(k + 1) * h;
        int status = oscillator.do_step(oscillator.instance, (double)k * h, h, 1);
        status |= oscillator.get_real(oscillator.instance, oscillator.reals, 2, rows + 1);
        if (status) return status;
    }
    return 0;
}

static inline int step_feedthrough(const Fmu *fmu, double t, double h, const double *reals, int *integer, int *boolean,
                                   double *row) {
    int status = fmu->set_real(fmu->instance, fmu->reals_in, 2, reals);
    status |= fmu->set_integer(fmu->instance, fmu->integers_in, 1, integer);
    status |= fmu->set_boolean(fmu->instance, fmu->booleans_in, 1, boolean);
    status |= fmu->do_step(fmu->instance, t, h, 1);
    status |= fmu->get_real(fmu->instance, fmu->reals, 2, row);
    status |= fmu->get_integer(fmu->instance, fmu->integers, 1, integer);
    status |= fmu->get_boolean(fmu->instance, fmu->booleans, 1, boolean);
    row[2] = *integer;
    row[3] = *boolean;
    return status;
}

/* A source into all four inputs of one Feedthrough, whose outputs go into another. A row: time, the source's value, and two
 * reals, an integer and a boolean of each. */
EXPORT int run_feedthroughs(const Fmu *fmus, const Native *natives, int64_t steps, double h, double rpm, double *rows) {
    const Fmu first = fmus[0], second = fmus[1];
    (void)rpm;
    for (int64_t k = 0; k < steps; k++, rows += 10) {
        const double t = (double)k * h;
        rows[0] = (double)(k + 1) * h;
        int status = natives[0].step(natives[0].self, t, h, NULL, rows + 1);
        const double both[2] = {rows[1], rows[1]};
        int integer = (int)rows[1], boolean = rows[1] != 0.0;
        status |= step_feedthrough(&first, t, h, both, &integer, &boolean, rows + 2);
        status |= step_feedthrough(&second, t, h, rows + 2, &integer, &boolean, rows + 6);
        if (status) return status;
    }
    return 0;
}

/* A source into a chain of FMUs, each with one real input, the first output of the one before, and some real outputs.
 * A row: time, the source's value, and the outputs of each. */
EXPORT int run_chain(const Fmu *fmus, int64_t count, const Native *source, int64_t steps, double h, double *rows) {
    for (int64_t k = 0; k < steps; k++) {
        const double t = (double)k * h, *u = rows + 1;
        rows[0] = (double)(k + 1) * h;
        int status = source->step(source->self, t, h, NULL, rows + 1);
        rows += 2;
        for (const Fmu *fmu = fmus, *end = fmus + count; fmu < end; fmu++) {
            status |= fmu->set_real(fmu->instance, fmu->reals_in, 1, u);
            status |= fmu->do_step(fmu->instance, t, h, 1);
            status |= fmu->get_real(fmu->instance, fmu->reals, fmu->n_reals, rows);
            u = rows;
            rows += fmu->n_reals;
        }
        if (status) return status;
    }
    return 0;
}
