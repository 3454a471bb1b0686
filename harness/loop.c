/* The step loop: steps a table of parts over a flat bus of doubles and records rows of it. */

typedef struct {
    Clock *clock;
    Part *parts; /* in the order they are stepped */
    int64_t count;
    const double *bus;
    int64_t size; /* of the bus */
    const int64_t *recorded; /* places on the bus of the columns of a row; NULL where they are its first places */
    int64_t columns;
    int64_t every; /* a row is written where it divides k */
    Whereabouts *here;
} Loop;

/* Says of the first of the parts stepped so far that has an output that is not finite; OK where all are. */
static SELDOM int diverged(const Loop *loop, int64_t stepped, int64_t k, Stop *stop)
{
    for (int64_t i = 0; i < stepped; i++) {
        const Part *part = &loop->parts[i];
        for (int64_t j = 0; j < part->outputs; j++) {
            if (isfinite(part->y[j])) continue;
            stop->part = i;
            stop->output = j;
            stop->k = k;
            return DIVERGED;
        }
    }
    return OK;
}

/* A step of a part, timed. */
static SELDOM int timed_step(Part *part, double t, double h)
{
    const double begin = seconds();
    const int status = part->step(part->self, t, h, part->u, part->y);
    part->took[part->timed++ % KEPT] = seconds() - begin;
    return status;
}

/* The sum of some numbers: it is not finite where one of them is not, or where it overflows itself. */
static inline double sum(const double *values, int64_t count)
{
    double total = 0.0;
    for (int64_t j = 0; j < count; j++) total += values[j];
    return total;
}

/* Copies numbers and returns their sum. */
static inline double copied(double *to, const double *values, int64_t count)
{
    double total = 0.0;
    for (int64_t j = 0; j < count; j++) {
        const double value = values[j];
        to[j] = value;
        total += value;
    }
    return total;
}

/* Whether a part that is not always stepped is stepped to instant k. */
static inline int is_due(const Clock *clock, const Part *part, int64_t k)
{
    return part->due ? part->due[k % clock->cycle] : k % part->period == 0;
}

/* The step of such a part to instant k: from where it was last stepped to. */
static inline void span(const Clock *clock, const Part *part, int64_t k, double *begin, double *length)
{
    const double steps = (double)(k - part->stepped);
    if (!clock->speed) {
        *begin = clock->t0 + (double)part->stepped * clock->h;
        *length = steps * clock->h;
    } else {
        *begin = part->reached;
        *length = part->stepped >= clock->anchor ? steps * clock->h : clock->next - part->reached;
    }
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
    int64_t timed = from + TIMED - from % TIMED;                   /* the next instant to time */
    int64_t until_row = loop->every - from % loop->every; /* so many instants on */
    const double t0 = clock->t0;
    double h = clock->h;

    for (int64_t k = from + 1; k <= to; k++) {
        double t = t0 + (double)(k - 1) * h;
        here->instant = k;
        if (clock->speed) {
            const int turned = turn(clock, k);
            if (turned != OK) {
                stop->part = -1;
                stop->k = k;
                return turned;
            }
            t = clock->t;
            h = clock->h;
        }
        for (Part *part = parts; part < end; part++) {
            here->part = part;
            double begin = t, length = h;
            if (!part->always) {
                if (!is_due(clock, part, k)) continue;
                span(clock, part, k, &begin, &length);
                part->stepped = k;
                part->reached = clock->next;
            }
            for (int64_t j = 0; j < part->gathers; j++) part->gathered[j] = bus[part->inputs[j]];
            const int status = k == timed ? timed_step(part, begin, length)
                                          : part->step(part->self, begin, length, part->u, part->y);
            if (status == OK) continue;
            if (status != WARNING) {
                if (diverged(loop, part - parts, k, stop)) return DIVERGED;
                stop->part = part - parts;
                stop->output = -1;
                stop->k = k;
                return status;
            }
            part->warnings++;
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
        if (!isfinite(check) && diverged(loop, loop->count, k, stop)) return DIVERGED;
        if (clock->speed && clock->next >= clock->stop) {
            stop->k = k;
            here->instant = k + 1;
            return ENDED;
        }
    }
    here->instant = to + 1;
    return OK;
}
