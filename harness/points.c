/* Points in time, or in crank angle, held or joined by lines: their value at a time. */
#include <math.h>
#include <stdint.h>

enum { HOLD = 0, LINEAR = 1 };
enum { ENDS_REFUSED = 0, ENDS_HELD = 1, ENDS_REPEATED = 2 };

typedef struct {
    int64_t count;
    const double *times, *values; /* ascending times */
    int64_t between, ends;
    double edge;    /* a point nearer than this to t is at t */
    int64_t cursor; /* where the last search ended: the next begins there, and would end at the same without it */
} Points;

/* The last point at or before a time; the first where there is none. Doubling steps from the cursor, then halving:
 * a search costs the logarithm of how far it goes, so a walk through all points costs less than two looks at each. */
static int64_t points_before(Points *p, double now)
{
    const double *times = p->times;
    int64_t low = p->cursor, high = low + 1; /* times[low] <= now < times[high], as far as there are points */
    if (now < times[low]) {
        high = low;
        low = 0;
    } else {
        for (int64_t stride = 1; high < p->count && times[high] <= now; stride *= 2) {
            low = high;
            high = stride < p->count - high ? high + stride : p->count;
        }
    }
    while (high - low > 1) {
        const int64_t middle = low + (high - low) / 2;
        if (times[middle] <= now) low = middle;
        else high = middle;
    }
    return p->cursor = low;
}

/* The value at a time; ERROR, and none, where the points end before and their ends are refused. */
static int points_value(Points *p, double t, double *value)
{
    const double first = p->times[0], last = p->times[p->count - 1];
    if (p->ends == ENDS_REFUSED && (t < first - p->edge || t > last + p->edge)) return ERROR;
    if (p->ends == ENDS_REPEATED) {
        const double span = last - first;
        double since = fmod(t - first, span);
        if (since < 0.0) since += span;
        if (since + p->edge >= span) since = 0.0;
        t = first + since;
    }
    const int64_t low = points_before(p, t + p->edge);
    const double before = p->values[low];
    if (p->between == HOLD || low == p->count - 1 || t <= p->times[low] + p->edge) {
        *value = before;
        return OK;
    }
    const double share = (t - p->times[low]) / (p->times[low + 1] - p->times[low]);
    *value = before + share * (p->values[low + 1] - before);
    return OK;
}
