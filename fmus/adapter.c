/* Steps one FMI 2.0 or 3.0 Co-Simulation instance without Python: set inputs, do step, get outputs.
 *
 * The bus holds doubles in SI units. Values of one type travel in one call (a Block). Reals that lie in a row on the
 * bus, in their SI unit, go straight between the bus and the FMU; all others pass a buffer. Nothing is allocated
 * while stepping. The FMU's messages are kept in a bounded log, the first ones and the last ones.
 * The structs are mirrored in slave.py.
 */
#include <math.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

/* What a step seldom does lies apart from what it always does: measured, a step is some 5 % faster so. */
#define SELDOM __attribute__((cold, noinline))

enum { OK, WARNING, DISCARD, ERROR, FATAL };
enum { FLOAT64, FLOAT32, INT8, UINT8, INT16, UINT16, INT32, UINT32, INT64, UINT64, BOOLEAN, INT_BOOLEAN };
enum { SETTING, STEPPING, GETTING, KEEPING, RESTORING, DERIVING };
enum { LOG_FIRST = 64, LOG_LAST = 192, CATEGORY_SIZE = 64, MESSAGE_SIZE = 1024 };
enum { LAST_SUCCESSFUL_TIME = 2, TERMINATED = 3 }; /* fmi2StatusKind */

typedef void (*Function)(void);

typedef struct {
    double time;
    int status;
    char category[CATEGORY_SIZE];
    char message[MESSAGE_SIZE];
} Entry;

typedef struct {
    size_t count; /* messages that ever came; those beyond LOG_FIRST + LOG_LAST push out the middle */
    Entry entries[LOG_FIRST + LOG_LAST];
} Log;

/* SI value = factor * value + offset */
typedef struct {
    size_t position; /* on the bus */
    double factor, offset;
} Conversion;

typedef struct {
    Function access;
    const uint32_t *references;
    size_t n_references, n_values;
    size_t first;    /* place on the bus of the first value */
    void *buffer;    /* the values as the FMU has them; NULL: they lie in a row on the bus as doubles */
    double *scratch; /* inputs in the FMU's units before they are narrowed; the buffer itself where that has doubles */
    const Conversion *conversions, *conversions_end; /* of each value of a buffered input; of outputs not in SI units */
    const size_t *positions; /* of each value on the bus */
    int type;
} Block;

typedef struct {
    void *instance;
    int failed; /* OK while the instance may be stepped, else the status that ended it: no call is made any more */
    int stage;  /* what was being done when the last status above WARNING came */
    double time; /* the communication point that messages are filed under */
    const Block *inputs, *inputs_end; /* set before each step */
    Function do_step;
    const Block *outputs, *outputs_end; /* got after it */
    Log *log;
    const Block *held, *held_end; /* inputs set at the start only */
    Function real_status, boolean_status; /* FMI 2's */
    int terminated; /* after a discard: the FMU asked to end the simulation */
    double last_successful_time;
    const Block *wired, *wired_end; /* `inputs` for steps that are given the whole bus as u */
    int reversible; /* steps may be taken back, and the FMU is told so */
} Slave;

typedef int (*Access2)(void *, const uint32_t *, size_t, void *);
typedef int (*Access3)(void *, const uint32_t *, size_t, void *, size_t);
typedef int (*DoStep2)(void *, double, double, int);
typedef int (*DoStep3)(void *, double, double, bool, bool *, bool *, bool *, double *);
typedef int (*Status2)(void *, int, void *);

/* ---- messages ---- */

static Entry *new_entry(const Slave *slave, int status, const char *category)
{
    Log *log = slave->log;
    size_t n = log->count++;
    Entry *entry = &log->entries[n < LOG_FIRST ? n : LOG_FIRST + (n - LOG_FIRST) % LOG_LAST];
    entry->time = slave->time;
    entry->status = status;
    snprintf(entry->category, CATEGORY_SIZE, "%s", category ? category : "");
    return entry;
}

static void mark_cut(Entry *entry, int length)
{
    static const char mark[] = " [...]";
    if (length < 0)
        snprintf(entry->message, MESSAGE_SIZE, "(a message that could not be formatted)");
    else if (length >= MESSAGE_SIZE)
        memcpy(entry->message + MESSAGE_SIZE - sizeof mark, mark, sizeof mark);
}

/* A printf format that writes to memory (%n) is kept as it stands; so is one without any conversion. */
static bool is_plain(const char *format)
{
    bool conversion = false;
    for (const char *c = format; *c; c++) {
        if (*c != '%')
            continue;
        if (*++c == '%')
            continue;
        c += strspn(c, "-+ #0123456789.*'hlLqjzt");
        if (*c == 'n' || *c == '\0')
            return true;
        conversion = true;
    }
    return !conversion && !strchr(format, '%');
}

/* A message of FMI 1 or 2 into the log: a format and its arguments. */
static void note(Slave *slave, int status, const char *category, const char *format, va_list arguments)
{
    Entry *entry = new_entry(slave, status, category);
    int length = !format || is_plain(format) ? snprintf(entry->message, MESSAGE_SIZE, "%s", format ? format : "")
                                             : vsnprintf(entry->message, MESSAGE_SIZE, format, arguments);
    mark_cut(entry, length);
}

EXPORT void fmi2_log(void *slave, const char *instance, int status, const char *category, const char *format, ...)
{
    (void)instance;
    if (!slave)
        return;
    va_list arguments;
    va_start(arguments, format);
    note(slave, status, category, format, arguments);
    va_end(arguments);
}

EXPORT void fmi3_log(void *slave, int status, const char *category, const char *message)
{
    if (!slave)
        return;
    Entry *entry = new_entry(slave, status, category);
    mark_cut(entry, snprintf(entry->message, MESSAGE_SIZE, "%s", message ? message : ""));
}

EXPORT void *fmi2_allocate(size_t count, size_t size)
{
    return calloc(count, size);
}

EXPORT void fmi2_free(void *memory)
{
    free(memory);
}

/* ---- values ---- */

/* The nearest integer, kept inside the type's range; a NaN becomes the lowest. What is a whole number, as nearly all
 * are, is spared the call of nearbyint. */
#define NARROW(T, LOW, HIGH)                                                                                           \
    for (size_t i = 0; i < n; i++) {                                                                                   \
        double v = from[i];                                                                                            \
        T whole = v > (double)(LOW) && v < (double)(HIGH) ? (T)v : (LOW);                                              \
        if ((double)whole != v) {                                                                                      \
            v = nearbyint(v);                                                                                          \
            whole = !(v > (double)(LOW)) ? (LOW) : v >= (double)(HIGH) ? (HIGH) : (T)v;                                \
        }                                                                                                              \
        ((T *)to)[i] = whole;                                                                                          \
    }                                                                                                                  \
    break

static SELDOM void narrow(int type, const double *from, void *to, size_t n)
{
    switch (type) {
    case FLOAT32:
        for (size_t i = 0; i < n; i++)
            ((float *)to)[i] = (float)from[i];
        break;
    case INT8: NARROW(int8_t, INT8_MIN, INT8_MAX);
    case UINT8: NARROW(uint8_t, 0, UINT8_MAX);
    case INT16: NARROW(int16_t, INT16_MIN, INT16_MAX);
    case UINT16: NARROW(uint16_t, 0, UINT16_MAX);
    case INT32: NARROW(int32_t, INT32_MIN, INT32_MAX);
    case UINT32: NARROW(uint32_t, 0, UINT32_MAX);
    case INT64: NARROW(int64_t, INT64_MIN, INT64_MAX);
    case UINT64: NARROW(uint64_t, 0, UINT64_MAX);
    case BOOLEAN:
        for (size_t i = 0; i < n; i++)
            ((bool *)to)[i] = from[i] != 0.0;
        break;
    case INT_BOOLEAN:
        for (size_t i = 0; i < n; i++)
            ((int *)to)[i] = from[i] != 0.0;
        break;
    }
}

#define WIDEN(T)                                                                                                       \
    for (size_t i = 0; i < n; i++)                                                                                     \
        y[positions[i]] = (double)((const T *)from)[i];                                                                \
    break

static SELDOM void widen_others(int type, const void *from, double *y, const size_t *positions, size_t n)
{
    switch (type) {
    case FLOAT64: WIDEN(double);
    case FLOAT32: WIDEN(float);
    case INT8: WIDEN(int8_t);
    case UINT8: WIDEN(uint8_t);
    case INT16: WIDEN(int16_t);
    case UINT16: WIDEN(uint16_t);
    case UINT32: WIDEN(uint32_t);
    case INT64: WIDEN(int64_t);
    case UINT64: WIDEN(uint64_t);
    case BOOLEAN: WIDEN(bool);
    case INT_BOOLEAN:
        for (size_t i = 0; i < n; i++)
            y[positions[i]] = ((const int *)from)[i] != 0;
        break;
    }
}

/* Without a call for the type that integers mostly have. */
static inline void widen(int type, const void *from, double *y, const size_t *positions, size_t n)
{
    if (type == INT32) {
        const int32_t *values = from;
        for (size_t i = 0; i < n; i++)
            y[positions[i]] = (double)values[i];
    } else {
        widen_others(type, from, y, positions, n);
    }
}

static inline int access_values(int version, const Block *block, void *instance, void *values)
{
    if (version == 2)
        return ((Access2)block->access)(instance, block->references, block->n_references, values);
    return ((Access3)block->access)(instance, block->references, block->n_references, values, block->n_values);
}

/* Ends a step in a status above WARNING. One that the standard does not know, and FMI 2's pending, which nobody here
 * waits for, are errors. */
static SELDOM int ended(Slave *slave, int status, int stage)
{
    if (status < OK || status > FATAL)
        status = ERROR;
    slave->stage = stage;
    if (status >= ERROR)
        slave->failed = status;
    return status;
}

static inline bool fine(int status)
{
    return (unsigned)status <= WARNING;
}

/* One pass from the bus to the buffer; of a value in its SI unit the factor is 1 and the offset 0, which change none. */
static inline const void *buffered_inputs(const Block *block, const double *u)
{
    double *value = block->scratch;
    for (const Conversion *c = block->conversions, *end = block->conversions_end; c < end; c++)
        *value++ = (u[c->position] - c->offset) / c->factor;
    if (block->type != FLOAT64)
        narrow(block->type, block->scratch, block->buffer, block->n_values);
    return block->buffer;
}

static inline int write_blocks(int version, Slave *slave, const Block *block, const Block *end, const double *u)
{
    int all = OK;
    for (; block < end; block++) {
        const void *values = block->buffer ? buffered_inputs(block, u) : u + block->first;
        int status = access_values(version, block, slave->instance, (void *)values);
        if (!fine(status))
            return ended(slave, status, SETTING);
        all |= status;
    }
    return all;
}

static inline int read_blocks(int version, Slave *slave, double *y)
{
    int all = OK;
    for (const Block *block = slave->outputs, *end = slave->outputs_end; block < end; block++) {
        int status = access_values(version, block, slave->instance, block->buffer ? block->buffer : y + block->first);
        if (!fine(status))
            return ended(slave, status, GETTING);
        all |= status;
        if (block->buffer)
            widen(block->type, block->buffer, y, block->positions, block->n_values);
        for (const Conversion *c = block->conversions, *last = block->conversions_end; c < last; c++)
            y[c->position] = c->factor * y[c->position] + c->offset;
    }
    return all;
}

/* ---- one step ---- */

static SELDOM int discarded2(Slave *slave)
{
    int terminated = 0;
    double time = NAN;
    int status = ((Status2)slave->boolean_status)(slave->instance, TERMINATED, &terminated);
    if (!fine(status) && status != DISCARD)
        return ended(slave, status, STEPPING);
    slave->terminated = fine(status) && terminated;
    status = ((Status2)slave->real_status)(slave->instance, LAST_SUCCESSFUL_TIME, &time);
    if (!fine(status) && status != DISCARD)
        return ended(slave, status, STEPPING);
    slave->last_successful_time = fine(status) ? time : NAN;
    return ended(slave, DISCARD, STEPPING);
}

static inline int do_step2(Slave *slave, double t, double h)
{
    int status = ((DoStep2)slave->do_step)(slave->instance, t, h, !slave->reversible);
    if (fine(status))
        return status;
    return status == DISCARD ? discarded2(slave) : ended(slave, status, STEPPING);
}

/* A step that ended in no plain success. One that asks to end has not been made; of one that stops short though it
 * was not allowed to, the rest is made while it gets on. */
static SELDOM int shortened3(Slave *slave, double t, double end, int status, bool terminate, double reached)
{
    bool event = false, early = true;
    while (fine(status) && !terminate && early && reached > t && reached < end) {
        t = reached;
        reached = end;
        early = false;
        status = ((DoStep3)slave->do_step)(slave->instance, t, end - t, !slave->reversible, &event, &terminate, &early,
                                           &reached);
    }
    if (fine(status) && !terminate && (!early || reached >= end))
        return status;
    slave->terminated = fine(status) && terminate;
    slave->last_successful_time = fine(status) ? reached : t;
    return ended(slave, fine(status) ? DISCARD : status, STEPPING);
}

static inline int do_step3(Slave *slave, double t, double h)
{
    bool event = false, terminate = false, early = false;
    double reached = t + h;
    int status = ((DoStep3)slave->do_step)(slave->instance, t, h, !slave->reversible, &event, &terminate, &early,
                                           &reached);
    if (fine(status) && !terminate && !early)
        return status;
    return shortened3(slave, t, t + h, status, terminate, reached);
}

static inline int advance(int version, Slave *slave, const Block *inputs, const Block *end, double t, double h,
                          const double *u, double *y)
{
    if (slave->failed)
        return slave->failed;
    slave->time = t;
    int written = write_blocks(version, slave, inputs, end, u);
    if (written > WARNING)
        return written;
    int stepped = version == 2 ? do_step2(slave, t, h) : do_step3(slave, t, h);
    if (stepped > WARNING)
        return stepped;
    return written | stepped | read_blocks(version, slave, y);
}

EXPORT int fmi2_step(void *self, double t, double h, const double *u, double *y)
{
    Slave *slave = self;
    return advance(2, slave, slave->inputs, slave->inputs_end, t, h, u, y);
}

EXPORT int fmi2_step_wired(void *self, double t, double h, const double *bus, double *y)
{
    Slave *slave = self;
    return advance(2, slave, slave->wired, slave->wired_end, t, h, bus, y);
}

EXPORT int fmi3_step(void *self, double t, double h, const double *u, double *y)
{
    Slave *slave = self;
    return advance(3, slave, slave->inputs, slave->inputs_end, t, h, u, y);
}

EXPORT int fmi3_step_wired(void *self, double t, double h, const double *bus, double *y)
{
    Slave *slave = self;
    return advance(3, slave, slave->wired, slave->wired_end, t, h, bus, y);
}

/* While initialising: set all inputs, also those that steps hold. */
static inline int initialise(int version, Slave *slave, const double *u)
{
    int status = write_blocks(version, slave, slave->held, slave->held_end, u);
    return status > WARNING ? status : status | write_blocks(version, slave, slave->inputs, slave->inputs_end, u);
}

EXPORT int fmi2_write(void *slave, const double *u)
{
    return initialise(2, slave, u);
}

EXPORT int fmi3_write(void *slave, const double *u)
{
    return initialise(3, slave, u);
}

EXPORT int fmi2_read(void *slave, double *y)
{
    return read_blocks(2, slave, y);
}

EXPORT int fmi3_read(void *slave, double *y)
{
    return read_blocks(3, slave, y);
}
