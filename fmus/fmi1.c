/* What is different where the FMU is one of FMI 1.0: its messages do not say whom they are for, and a discarded step
 * tells nothing of an end. Compiled in one unit behind adapter.c. */

enum { LISTENERS = 256 };
static Slave *listeners[LISTENERS]; /* by instance; a slot is NULL when free */
static Slave *newborn;              /* the one being instantiated: its instance is not known yet */

/* Let the slave hear messages until it is dismissed; 0 where there are too many already. */
EXPORT int fmi1_listen(void *slave)
{
    newborn = slave;
    for (int i = 0; i < LISTENERS; i++)
        if (!listeners[i] || listeners[i] == slave) {
            listeners[i] = slave;
            return 1;
        }
    return 0;
}

EXPORT void fmi1_dismiss(void *slave)
{
    for (int i = 0; i < LISTENERS; i++)
        if (listeners[i] == slave)
            listeners[i] = NULL;
    if (newborn == slave)
        newborn = NULL;
}

EXPORT void fmi1_log(void *instance, const char *name, int status, const char *category, const char *format, ...)
{
    Slave *slave = newborn;
    (void)name;
    for (int i = 0; i < LISTENERS; i++)
        if (instance && listeners[i] && listeners[i]->instance == instance)
            slave = listeners[i];
    if (!slave)
        return;
    va_list arguments;
    va_start(arguments, format);
    note(slave, status, category, format, arguments);
    va_end(arguments);
}

static int do_step1(Slave *slave, double t, double h)
{
    int status = ((int (*)(void *, double, double, char))slave->do_step)(slave->instance, t, h, 1);
    if (status != DISCARD)
        return fine(status) ? status : ended(slave, status, STEPPING);
    double time = NAN;
    int answer = ((Status2)slave->real_status)(slave->instance, LAST_SUCCESSFUL_TIME, &time);
    if (!fine(answer) && answer != DISCARD)
        return ended(slave, answer, STEPPING);
    slave->last_successful_time = fine(answer) ? time : NAN;
    return ended(slave, DISCARD, STEPPING);
}

EXPORT int fmi1_step(void *self, double t, double h, const double *u, double *y)
{
    Slave *slave = self;
    if (slave->failed)
        return slave->failed;
    slave->time = t;
    int written = write_blocks(1, slave, slave->inputs, slave->inputs_end, u);
    if (written > WARNING)
        return written;
    int stepped = do_step1(slave, t, h);
    if (stepped > WARNING)
        return stepped;
    return written | stepped | read_blocks(1, slave, y);
}

EXPORT int fmi1_write(void *slave, const double *u)
{
    return initialise(1, slave, u);
}

EXPORT int fmi1_read(void *slave, double *y)
{
    return read_blocks(1, slave, y);
}
