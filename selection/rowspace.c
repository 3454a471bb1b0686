/* Exact row spaces modulo a Mersenne prime 2^bits - 1: which unit vectors do the rows of sets of sensors span, and when? */

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

__extension__ typedef unsigned __int128 Wide;

typedef struct {
    int bits;
    uint64_t prime;
} Field;

static Field field_of(int bits)
{
    Field f = {bits, ((uint64_t)1 << bits) - 1};
    return f;
}

static uint64_t multiply(Field f, uint64_t a, uint64_t b)
{
    const Wide product = (Wide)a * b;
    const uint64_t sum = ((uint64_t)product & f.prime) + (uint64_t)(product >> f.bits);
    return sum >= f.prime ? sum - f.prime : sum;
}

static uint64_t add(Field f, uint64_t a, uint64_t b)
{
    const uint64_t sum = a + b;
    return sum >= f.prime ? sum - f.prime : sum;
}

static uint64_t subtract(Field f, uint64_t a, uint64_t b)
{
    return a >= b ? a - b : a + (f.prime - b);
}

/* By Euclid: a of 1 ... prime - 1; the factors stay below the prime in size. */
static uint64_t inverse(Field f, uint64_t a)
{
    int64_t before = 0, now = 1;
    uint64_t high = f.prime, low = a;
    while (low > 1) {
        const uint64_t quotient = high / low, rest = high % low;
        const int64_t next = before - (int64_t)quotient * now;
        before = now, now = next;
        high = low, low = rest;
    }
    return now < 0 ? f.prime - (uint64_t)-now : (uint64_t)now;
}

/* to -= factor * row */
static void eliminate(Field f, size_t n, uint64_t *to, uint64_t factor, const uint64_t *row)
{
    for (size_t j = 0; j < n; j++)
        to[j] = subtract(f, to[j], multiply(f, factor, row[j]));
}

/* A reduced echelon basis: row k has its first entry, a one, in column first[k], where all other rows have zeros. */
typedef struct {
    size_t n, rank;
    uint64_t *rows;
    size_t *first;
} Space;

/* Takes a row, which is changed, into the space; 1 where it was not in it. */
static int insert(Field f, Space *s, uint64_t *row)
{
    const size_t n = s->n;
    for (size_t k = 0; k < s->rank; k++)
        if (row[s->first[k]])
            eliminate(f, n, row, row[s->first[k]], s->rows + k * n);
    size_t first = 0;
    while (first < n && !row[first])
        first++;
    if (first == n) return 0;
    const uint64_t scale = inverse(f, row[first]);
    for (size_t j = first; j < n; j++)
        row[j] = multiply(f, scale, row[j]);
    for (size_t k = 0; k < s->rank; k++) {
        uint64_t *other = s->rows + k * n;
        if (other[first]) eliminate(f, n, other, other[first], row);
    }
    memcpy(s->rows + s->rank * n, row, n * sizeof *row);
    s->first[s->rank++] = first;
    return 1;
}

/* Notes rho for each unit vector in the space that was in none before; how many are in it. */
static size_t note_units(const Space *s, int64_t rho, int64_t *found)
{
    size_t units = 0;
    for (size_t k = 0; k < s->rank; k++) {
        const uint64_t *row = s->rows + k * s->n;
        size_t entries = 0;
        for (size_t j = 0; j < s->n && entries < 2; j++)
            entries += row[j] != 0;
        if (entries > 1) continue;
        units++;
        if (!found[s->first[k]]) found[s->first[k]] = rho;
    }
    return units;
}

/* Rows c A^k, k = 0 ... count - 1, of each of `sensors` rows c: sensors[s][n], a[n][n], powers[s][count][n]. */
EXPORT void selection_powers(
    int bits, size_t n, size_t sensors, size_t count, const uint64_t *a, const uint64_t *rows, uint64_t *powers)
{
    const Field f = field_of(bits);
    for (size_t s = 0; s < sensors; s++) {
        uint64_t *row = powers + s * count * n;
        memcpy(row, rows + s * n, n * sizeof *row);
        for (size_t k = 1; k < count; k++, row += n)
            for (size_t j = 0; j < n; j++) {
                uint64_t sum = 0;
                for (size_t i = 0; i < n; i++)
                    if (row[i]) sum = add(f, sum, multiply(f, row[i], a[i * n + j]));
                row[n + j] = sum;
            }
    }
}

/* For each of `count` sets of `size` sensors the least rho at which its rows c A^k, k < rho - lag, span a unit vector;
 * found[count][n], 0 where they never do. powers[sensors][steps][n] are the rows there are, lags[sensors],
 * members[count][size]; memory of n n + n uint64 and n size_t. done[count] is 0 where more rows would tell more. */
EXPORT void selection_indices(int bits, size_t n, size_t steps, const uint64_t *powers, const int64_t *lags, size_t count,
                              size_t size, const int64_t *members, uint64_t *memory, size_t *first, int64_t *found,
                              uint8_t *done)
{
    const Field f = field_of(bits);
    memset(found, 0, count * n * sizeof *found);
    for (size_t i = 0; i < count; i++, members += size, found += n) {
        Space space = {n, 0, memory, first};
        uint64_t *row = memory + n * n;
        int64_t last_lag = 0;
        for (size_t m = 0; m < size; m++)
            last_lag = lags[members[m]] > last_lag ? lags[members[m]] : last_lag;
        done[i] = steps == n;
        for (int64_t rho = 1; rho <= (int64_t)steps + last_lag; rho++) {
            int grew = 0;
            for (size_t m = 0; m < size && space.rank < n; m++) {
                const int64_t power = rho - 1 - lags[members[m]];
                if (power < 0) continue;
                if (power >= (int64_t)steps) {
                    if (steps < n) goto next;
                    continue;
                }
                memcpy(row, powers + ((size_t)members[m] * steps + (size_t)power) * n, n * sizeof *row);
                grew |= insert(f, &space, row);
            }
            /* Where no row of a step is new, no later one is: each is an old one times A. */
            if ((!grew && rho > last_lag) || note_units(&space, rho, found) == n) {
                done[i] = 1;
                break;
            }
        }
    next:;
    }
}
