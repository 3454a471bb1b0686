/* The step loop: steps a table of parts over a flat bus of doubles and records rows of it. */

/* The sum of some numbers: it is not finite where one of them is not, or where it overflows itself. */
static inline double sum(const double *values, int64_t count)
{
    double even = 0.0, odd = 0.0; /* two chains of additions take less time than one */
    int64_t j = 0;
    for (; j + 1 < count; j += 2) {
        even += values[j];
        odd += values[j + 1];
    }
    return j < count ? even + odd + values[j] : even + odd;
}

/* Copies numbers and returns their sum. */
static inline double copied(double *to, const double *values, int64_t count)
{
    double even = 0.0, odd = 0.0;
    int64_t j = 0;
    for (; j + 1 < count; j += 2) {
        const double value = values[j], other = values[j + 1];
        to[j] = value;
        to[j + 1] = other;
        even += value;
        odd += other;
    }
    if (j < count) even += to[j] = values[j];
    return even + odd;
}

/* Steps from instant `from` to instant `to` and writes a row of time and `columns` numbers for each that `every`
 * divides. Returns OK; or the status above WARNING that stopped it: then `stop` says where, and there is no row of that
 * instant; or ENDED at the instant whose row was the last, where the clock reached its stop. Outputs are looked at once
 * an instant: a part that fails on what another left is no culprit. */
EXPORT int crankbench_advance(const Loop *loop, int64_t from, int64_t to, double *rows, Stop *stop)
{
    Clock *const clock = loop->clock;
    const double *bus = loop->bus;
    const int64_t *recorded = loop->recorded;
    const int64_t columns = loop->columns, size = loop->size;
    Part *const parts = loop->parts, *const end = parts + loop->count;
    Whereabouts *const here = loop->here;
    int64_t timed = from + TIMED - from % TIMED;          /* the next instant to time */
    int64_t until_row = loop->every - from % loop->every; /* so many instants on */
    const double t0 = clock->t0;
    double h = clock->h;

    for (int64_t k = from + 1; k <= to; k++) {
        double t = t0 + (double)(k - 1) * h;
        Part *part = parts;
        here->instant = k;
        if (clock->speed) {
            int status = turn(clock, k);
            if (status != OK) return stopped(loop, parts - 1, k, status, stop);
            if (loop->steering) {
                status = steer(loop, k, stop);
                if (status != OK) return status;
                part = loop->steering->end;
            }
            t = clock->t;
            h = clock->h;
        }
        for (; part < end; part++) {
            here->part = part;
            double begin = t, length = h;
            if (!part->always) {
                if (part->group) {
                    const int status = step_group(loop, part->group, k, t, h, stop);
                    if (status != OK) return status;
                    part = part->group->end - 1;
                    continue;
                }
                if (!is_due(clock, part, k)) continue;
                span(clock, part, k, &begin, &length);
            }
            int status = step_part(loop, part, begin, length, k == timed);
            if (status != OK) {
                status = judged(loop, part, k, status, stop);
                if (status != OK) return status;
            }
        }
        if (k == timed) timed += TIMED;
        double check;
        if (--until_row) {
            check = sum(bus, size);
        } else {
            until_row = loop->every;
            *rows++ = clock->speed ? clock->next : t0 + (double)k * h;
            if (recorded) {
                check = sum(bus, size);
                for (int64_t j = 0; j < columns; j++) rows[j] = bus[recorded[j]];
            } else {
                check = copied(rows, bus, columns) + sum(bus + columns, size - columns);
            }
            rows += columns;
        }
        if (!isfinite(check) && diverged(loop, end, k, stop)) return DIVERGED;
        if (clock->speed && clock->next >= clock->stop) {
            stop->k = k;
            here->instant = k + 1;
            return ENDED;
        }
    }
    here->instant = to + 1;
    return OK;
}
