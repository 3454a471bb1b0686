/* Faults: when they act, and since when. */

/* Open for what belongs to a time from <= t < until [s] and to a sample first <= j < last. Ends that are not given lie
 * at the ends of the range. */
typedef struct {
    double from, until;
    int64_t first, last;
} Window;

/* Times nearer to an end than `edge` are at it. */
static inline int is_open(const Window *w, double t, double edge, int64_t sample)
{
    return t >= w->from - edge && t < w->until - edge && sample >= w->first && sample < w->last;
}

typedef struct {
    int64_t kind, code;
    double value;
    Window window;
    /* state: how many samples it has acted, this one counted, 0 while it does not; and the time of its begin */
    int64_t acted;
    double begin;
    /* the state kept; the begin stays what it was, or is met again */
    int64_t kept_acted;
} Fault;

/* Brings the faults to a sample; the code of the first listed that acts then, 0 where none does. */
static int64_t faults_at(Fault *faults, int64_t count, double t, double edge, int64_t sample)
{
    int64_t code = 0;
    for (int64_t i = count - 1; i >= 0; i--) {
        Fault *fault = &faults[i];
        if (!is_open(&fault->window, t, edge, sample)) {
            fault->acted = 0;
            continue;
        }
        if (!fault->acted++) fault->begin = isfinite(fault->window.from) ? fault->window.from : t;
        code = fault->code;
    }
    return code;
}

static void keep_faults(Fault *faults, int64_t count)
{
    for (int64_t i = 0; i < count; i++) faults[i].kept_acted = faults[i].acted;
}

static void restore_faults(Fault *faults, int64_t count)
{
    for (int64_t i = 0; i < count; i++) faults[i].acted = faults[i].kept_acted;
}
