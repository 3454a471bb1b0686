/* FMI 3.0's clocks that tick at known times, and Co-Simulation that hands over at events. Compiled in one unit between
 * adapter.c and exchange.c; the structs are mirrored in clocks.py. */

enum { EVENT_ITERATIONS = 1000, STANDSTILLS = 1000 }; /* more of them is an error with a name, not a longer wait */

typedef struct {
    size_t count;
    const uint32_t *references;
    const double *first, *interval; /* s from the start: of the first tick, and between ticks */
    int64_t *ticks;                 /* so far */
    uint32_t *due;                  /* a place for each clock */
    bool *on;
    Function set_clock;
    double start;
} Clocks;

/* A difference of times that is rounding: 0.3 + 2.7 is not quite 3.0. */
static double rounding(double a, double b)
{
    return 8 * 2.220446049250313e-16 * fmax(fabs(a), fabs(b));
}

static void rewind_clocks(Clocks *clocks, double t0)
{
    clocks->start = t0;
    for (size_t i = 0; i < clocks->count; i++)
        clocks->ticks[i] = 0;
}

static double tick_time(const Clocks *clocks, size_t i)
{
    return clocks->start + (clocks->first[i] + (double)clocks->ticks[i] * clocks->interval[i]);
}

static double next_tick(const Clocks *clocks)
{
    double next = INFINITY;
    for (size_t i = 0; i < clocks->count; i++)
        next = fmin(next, tick_time(clocks, i));
    return next;
}

/* In event mode at t: activate what is due. */
static int tick(Clocks *clocks, void *instance, double t)
{
    size_t due = 0;
    for (size_t i = 0; i < clocks->count; i++)
        if (tick_time(clocks, i) <= t + rounding(t, clocks->start)) {
            clocks->due[due++] = clocks->references[i];
            clocks->ticks[i]++;
        }
    if (!due)
        return OK;
    typedef int (*SetClock)(void *, const uint32_t *, size_t, const bool *);
    return ((SetClock)clocks->set_clock)(instance, clocks->due, due, clocks->on);
}

typedef struct {
    Slave *slave;
    Clocks clocks;
    Function enter_event_mode, update_states, enter_step_mode;
    double *last_inputs; /* as they were set last */
    size_t inputs;
    int64_t events;
} EventMode;

static int stand_still(Slave *slave, double t, const char *what)
{
    Entry *entry = new_entry(slave, ERROR, "event mode");
    mark_cut(entry, snprintf(entry->message, MESSAGE_SIZE, "%s at t = %.9g s", what, t));
    return ended(slave, ERROR, STEPPING);
}

/* In event mode at t, which is left for step mode. */
static int settle_events(EventMode *e, double t)
{
    Slave *slave = e->slave;
    typedef int (*Update)(void *, bool *, bool *, bool *, bool *, bool *, double *);
    int status = tick(&e->clocks, slave->instance, t);
    if (!fine(status))
        return ended(slave, status, STEPPING);
    e->events++;
    bool again = true;
    for (int round = 0; again; round++) {
        bool terminate = false, nominals = false, values = false, defined = false;
        double next = 0.0;
        again = false;
        if (round >= EVENT_ITERATIONS)
            return stand_still(slave, t, "event iteration does not settle: the FMU always needs new discrete states");
        status = ((Update)e->update_states)(slave->instance, &again, &terminate, &nominals, &values, &defined, &next);
        if (!fine(status))
            return ended(slave, status, STEPPING);
        if (terminate) {
            slave->terminated = 1;
            slave->last_successful_time = t;
            return ended(slave, DISCARD, STEPPING);
        }
    }
    status = ((int (*)(void *))e->enter_step_mode)(slave->instance);
    return fine(status) ? OK : ended(slave, status, STEPPING);
}

static int event_at(EventMode *e, double t, const double *u)
{
    Slave *slave = e->slave;
    int status = ((int (*)(void *))e->enter_event_mode)(slave->instance);
    if (!fine(status))
        return ended(slave, status, STEPPING);
    if (u) {
        status = write_blocks(3, slave, slave->inputs, slave->inputs_end, u);
        if (status > WARNING)
            return status;
        memcpy(e->last_inputs, u, e->inputs * sizeof *u);
    }
    return settle_events(e, t);
}

EXPORT int event_mode_step(void *self, double t, double h, const double *u, double *y)
{
    EventMode *e = self;
    Slave *slave = e->slave;
    if (slave->failed)
        return slave->failed;
    slave->time = t;
    int status = OK, still = 0;
    if (e->inputs && memcmp(u, e->last_inputs, e->inputs * sizeof *u))
        status = event_at(e, t, u);
    double now = t, end = t + h;
    while (status <= WARNING && now < end) {
        bool event = false, terminate = false, early = false;
        double due = next_tick(&e->clocks), stop = due < end + rounding(t, end) ? fmax(due, now) : end;
        double reached = stop;
        if (stop - now > rounding(stop, now)) {
            status = ((DoStep3)slave->do_step)(slave->instance, now, stop - now, !slave->reversible, &event,
                                               &terminate, &early, &reached);
            if (!fine(status) || terminate) {
                slave->terminated = fine(status) && terminate;
                slave->last_successful_time = fine(status) && early ? reached : now;
                return ended(slave, fine(status) ? DISCARD : status, STEPPING);
            }
        }
        if (!early || reached > stop)
            reached = stop;
        still = reached > now ? 0 : still + 1;
        if (still > STANDSTILLS)
            return stand_still(slave, now, "the step does not get on: the FMU returns early each time");
        now = reached;
        if (event || next_tick(&e->clocks) <= now + rounding(now, t))
            status = event_at(e, now, NULL);
    }
    return status > WARNING ? status : read_blocks(3, slave, y);
}

/* After initialisation, in event mode: to step mode at t0. */
EXPORT int event_mode_start(void *self, double t0, const double *u, double *y)
{
    EventMode *e = self;
    e->events = 0;
    rewind_clocks(&e->clocks, t0);
    if (e->inputs)
        memcpy(e->last_inputs, u, e->inputs * sizeof *u);
    int status = settle_events(e, t0);
    return status > WARNING ? status : read_blocks(3, e->slave, y);
}
