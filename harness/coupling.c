/* Parts that are stepped together and taken back: algebraic loops, plants that take smaller steps, exact steering. */

typedef struct {
    int (*keep)(void *self);
    int (*restore)(void *self);
    int (*derivative)(void *self, const double *du, double *dy); /* NULL where there is none */
    void *self;
} Past;

enum { FIXED_POINT = 0, NEWTON = 1, SMALLER_STEPS = 2, STEERED = 3 };
/* Smaller steps are whole steps halved so often at the most. */
enum { DEEPEST = 20 };
/* Differences give derivatives to some 1e-8: a loop whose gain is nearer to one than this has no solution to speak of. */
static const double SINGULAR = 1e-7;

/* Contiguous parts. An algebraic loop has a part at its head that puts the torn signals' values of the instant before
 * by, as the first guess: the places `given` on the bus are what the parts behind it read, `made` what these make of
 * it. The loop is solved where they are the same. */
struct Group {
    int64_t kind;
    Part *first, *end;
    const Past *pasts;     /* of each part */
    double *saved;         /* the outputs of all parts as they were at the instant before */
    double *other;         /* and as another way led to them */
    const double *scales;  /* of each output of all parts: what counts as a small change of it */
    double tolerance, relaxation;
    int64_t iterations;    /* most at an instant */
    int64_t torn;
    const int64_t *given, *made;
    const double *nominals; /* of each torn signal */
    double *work;           /* torn * (torn + 4) numbers */
    double *slopes;         /* as many numbers as the bus has: derivatives of its values */
    int64_t derivatives;    /* 1: Newton's method is given directional derivatives, 0: it takes differences */
    /* what became of it */
    int64_t level;          /* how often a step was halved last */
    int64_t steps, rejected, rounds;
    double missed;          /* how far from solved it was when it was given up */
    int64_t place;          /* on the bus, of the signal that was furthest */
};

static int keep_all(const Loop *loop, Group *group, int64_t k, Stop *stop)
{
    double *saved = group->saved;
    for (Part *part = group->first; part < group->end; part++) {
        const Past *past = &group->pasts[part - group->first];
        loop->here->part = part;
        if (past->keep) {
            const int status = past->keep(past->self);
            if (status > WARNING) return stopped(loop, part, k, status, stop);
        }
        memcpy(saved, part->y, (size_t)part->outputs * sizeof *saved);
        saved += part->outputs;
    }
    return OK;
}

static int restore_all(const Loop *loop, Group *group, int64_t k, Stop *stop)
{
    const double *saved = group->saved;
    for (Part *part = group->first; part < group->end; part++) {
        const Past *past = &group->pasts[part - group->first];
        loop->here->part = part;
        if (past->restore) {
            const int status = past->restore(past->self);
            if (status > WARNING) return stopped(loop, part, k, status, stop);
        }
        memcpy(part->y, saved, (size_t)part->outputs * sizeof *saved);
        saved += part->outputs;
    }
    return OK;
}

/* Steps the parts of a group one after the other over the same span. */
static int sweep(const Loop *loop, Part *from, Part *end, int64_t k, double t, double h, Stop *stop)
{
    for (Part *part = from; part < end; part++) {
        loop->here->part = part;
        int status = step_part(loop, part, t, h, 0);
        if (status != OK) status = judged(loop, part, k, status, stop);
        if (status != OK) return status;
    }
    return OK;
}

/* ---- algebraic loops ---- */

/* What the parts make of a guess: restored, given the guess, and stepped. */
static int evaluate(const Loop *loop, Group *group, const double *guess, int64_t k, double t, double h, Stop *stop)
{
    int status = restore_all(loop, group, k, stop);
    if (status != OK) return status;
    for (int64_t i = 0; i < group->torn; i++) loop->bus[group->given[i]] = guess[i];
    status = sweep(loop, group->first + 1, group->end, k, t, h, stop);
    if (status != OK) return status;
    group->rounds++;
    for (int64_t i = 0; i < group->torn; i++)
        if (!isfinite(loop->bus[group->made[i]]) && diverged(loop, group->end, k, stop)) return DIVERGED;
    return OK;
}

/* How far a guess is from what is made of it, relative to the larger of its value and its nominal value. */
static double distance(const Loop *loop, Group *group, const double *guess, double *residual)
{
    double worst = 0.0;
    for (int64_t i = 0; i < group->torn; i++) {
        const double made = loop->bus[group->made[i]];
        residual[i] = made - guess[i];
        const double missed = fabs(residual[i]) / fmax(fmax(fabs(made), fabs(guess[i])), group->nominals[i]);
        if (missed >= worst) {
            worst = missed;
            group->place = group->made[i];
        }
    }
    return worst;
}

/* The derivative of what is made with respect to one torn signal, passed on from part to part. */
static int passed_on(const Loop *loop, Group *group, int64_t column, int64_t k, Stop *stop)
{
    memset(group->slopes, 0, (size_t)loop->size * sizeof *group->slopes);
    group->slopes[group->given[column]] = 1.0;
    for (Part *part = group->first + 1; part < group->end; part++) {
        const Past *past = &group->pasts[part - group->first];
        double *dy = group->slopes + (part->y - loop->bus);
        for (int64_t j = 0; j < part->gathers; j++) part->gathered[j] = group->slopes[part->inputs[j]];
        const double *du = part->gathers ? part->gathered : group->slopes + (part->u - loop->bus);
        loop->here->part = part;
        const int status = past->derivative(past->self, du, dy);
        if (status > WARNING) return stopped(loop, part, k, status, stop);
    }
    return OK;
}

/* Solves a dense system in place by elimination with pivoting, matrix row-major with entries of order one; 0 where a
 * pivot is less than SINGULAR of its row's largest entry or of one, the larger. */
static int eliminate(double *matrix, double *b, int64_t n)
{
    for (int64_t c = 0; c < n; c++) {
        int64_t best = c;
        double largest = 0.0;
        for (int64_t i = c; i < n; i++) {
            double scale = 1.0;
            for (int64_t j = c; j < n; j++) scale = fmax(scale, fabs(matrix[i * n + j]));
            if (fabs(matrix[i * n + c]) / scale > largest) {
                largest = fabs(matrix[i * n + c]) / scale;
                best = i;
            }
        }
        if (!(largest > SINGULAR)) return 0;
        for (int64_t j = 0; j < n && best != c; j++) {
            const double swap = matrix[c * n + j];
            matrix[c * n + j] = matrix[best * n + j];
            matrix[best * n + j] = swap;
        }
        const double swap = b[c];
        b[c] = b[best];
        b[best] = swap;
        for (int64_t i = c + 1; i < n; i++) {
            const double factor = matrix[i * n + c] / matrix[c * n + c];
            for (int64_t j = c; j < n; j++) matrix[i * n + j] -= factor * matrix[c * n + j];
            b[i] -= factor * b[c];
        }
    }
    for (int64_t i = n - 1; i >= 0; i--) {
        for (int64_t j = i + 1; j < n; j++) b[i] -= matrix[i * n + j] * b[j];
        b[i] /= matrix[i * n + i];
    }
    return 1;
}

/* The correction of a guess by Newton's method, (1 - dG/dz) dz = G(z) - z in units of the nominal values, in place of
 * the residual; UNSOLVED where the matrix is singular. The parts were stepped with the guess just now. */
static int newton(const Loop *loop, Group *group, double *guess, double *residual, int64_t k, double t, double h,
                  Stop *stop)
{
    const int64_t n = group->torn;
    double *matrix = residual + n, *made = matrix + n * n;
    for (int64_t i = 0; i < n; i++) made[i] = loop->bus[group->made[i]];
    for (int64_t c = 0; c < n; c++) {
        double width = 1.0;
        const double *after = group->slopes;
        int status;
        if (group->derivatives) {
            status = passed_on(loop, group, c, k, stop);
        } else {
            const double kept = guess[c];
            guess[c] += 1e-7 * fmax(fabs(kept), group->nominals[c]);
            width = guess[c] - kept;
            after = loop->bus;
            status = evaluate(loop, group, guess, k, t, h, stop);
            guess[c] = kept;
        }
        if (status != OK) return status;
        for (int64_t i = 0; i < n; i++) {
            const double change = group->derivatives ? after[group->made[i]] : after[group->made[i]] - made[i];
            matrix[i * n + c] = (i == c) - change / width * group->nominals[c] / group->nominals[i];
        }
    }
    for (int64_t i = 0; i < n; i++) residual[i] /= group->nominals[i];
    if (!eliminate(matrix, residual, n)) return UNSOLVED;
    for (int64_t i = 0; i < n; i++) residual[i] *= group->nominals[i];
    return OK;
}

static int solve(const Loop *loop, Group *group, int64_t k, double t, double h, Stop *stop)
{
    const int64_t n = group->torn;
    double *guess = group->work, *residual = guess + n;
    int status = keep_all(loop, group, k, stop);
    if (status == OK) status = sweep(loop, group->first, group->first + 1, k, t, h, stop);
    if (status != OK) return status;
    for (int64_t i = 0; i < n; i++) guess[i] = loop->bus[group->given[i]];
    group->steps++;
    for (int64_t round = 0; round < group->iterations; round++) {
        status = evaluate(loop, group, guess, k, t, h, stop);
        if (status != OK) return status;
        group->missed = distance(loop, group, guess, residual);
        if (group->missed <= group->tolerance) return OK;
        if (group->kind == NEWTON) {
            status = newton(loop, group, guess, residual, k, t, h, stop);
            if (status == UNSOLVED) break;
            if (status != OK) return status;
        }
        const double share = group->kind == NEWTON ? 1.0 : group->relaxation;
        for (int64_t i = 0; i < n; i++) guess[i] += share * residual[i];
    }
    return stopped(loop, group->first, k, UNSOLVED, stop);
}

/* ---- smaller steps ---- */

/* How far apart two ways led: the outputs now and those in `other`, relative to the larger of value and scale. */
static double apart(const Loop *loop, Group *group)
{
    double worst = 0.0;
    const double *other = group->other, *scale = group->scales;
    for (Part *part = group->first; part < group->end; part++) {
        for (int64_t j = 0; j < part->outputs; j++, other++, scale++) {
            const double missed = fabs(part->y[j] - *other) / fmax(fabs(part->y[j]), *scale);
            if (missed >= worst || isnan(missed)) {
                worst = missed;
                group->place = part->y + j - loop->bus;
            }
        }
    }
    return worst;
}

/* Steps plants that feed each other over [t, t + h] by steps h / 2^n: each is made whole and in two halves, and where
 * these lead too far apart it is taken back and halved. What the halves lead to is kept. */
static int smaller_steps(const Loop *loop, Group *group, int64_t k, double t, double h, Stop *stop)
{
    const int64_t whole = (int64_t)1 << DEEPEST;
    int64_t done = 0;
    while (done < whole) {
        const int64_t part_of = whole >> group->level;
        const double begin = t + h * (double)done / (double)whole, length = h * (double)part_of / (double)whole;
        const double middle = begin + 0.5 * length;
        int status = keep_all(loop, group, k, stop);
        if (status == OK) status = sweep(loop, group->first, group->end, k, begin, length, stop);
        if (status != OK) return status;
        double *other = group->other;
        for (Part *part = group->first; part < group->end; part++) {
            memcpy(other, part->y, (size_t)part->outputs * sizeof *other);
            other += part->outputs;
        }
        status = restore_all(loop, group, k, stop);
        if (status == OK) status = sweep(loop, group->first, group->end, k, begin, middle - begin, stop);
        if (status == OK) status = sweep(loop, group->first, group->end, k, middle, begin + length - middle, stop);
        if (status != OK) return status;
        group->missed = apart(loop, group);
        if (group->missed <= group->tolerance) {
            done += part_of;
            group->steps++;
            if (group->level && group->missed < 0.1 * group->tolerance && done % (2 * part_of) == 0) group->level--;
            continue;
        }
        if (diverged(loop, group->end, k, stop)) return DIVERGED;
        group->rejected++;
        if (++group->level > DEEPEST) {
            group->level = DEEPEST;
            return stopped(loop, group->first, k, UNSOLVED, stop);
        }
        status = restore_all(loop, group, k, stop);
        if (status != OK) return status;
    }
    return OK;
}

/* Steps the parts of a group to instant k, at the pace of the first. */
static SELDOM int step_group(const Loop *loop, Group *group, int64_t k, double t, double h, Stop *stop)
{
    Part *first = group->first;
    if (first->period != 1 || first->due) {
        if (!is_due(loop->clock, first, k)) return OK;
        span(loop->clock, first, k, &t, &h);
    }
    return group->kind == SMALLER_STEPS ? smaller_steps(loop, group, k, t, h, stop)
                                        : solve(loop, group, k, t, h, stop);
}

/* ---- steering ---- */

/* Steps the parts up to the plant to instant k so that its angle is the clock's: what is missed changes the step, which
 * is then repeated, until it is a ten billionth of a radian, or what doubles leave of that. */
static SELDOM int steer(const Loop *loop, int64_t k, Stop *stop)
{
    Group *group = loop->steering;
    Clock *clock = loop->clock;
    int status = keep_all(loop, group, k, stop);
    if (status != OK) return status;
    group->steps++;
    for (int64_t round = 0; round < group->iterations; round++) {
        status = sweep(loop, group->first, group->end, k, clock->t, clock->h, stop);
        if (status != OK) return status;
        group->rounds++;
        const double missed = ahead(clock, k), speed = *clock->speed;
        group->missed = fabs(missed);
        if (fabs(missed) <= 1e-10 + 4.0 * 2.220446049250313e-16 * fabs(*clock->angle)) return OK;
        const double h = clock->h - missed / speed;
        if (!(speed >= clock->slowest && h > 0.0 && h < 4.0 * clock->h)) break;
        status = restore_all(loop, group, k, stop);
        if (status != OK) return status;
        stride(clock, k, h);
    }
    return stopped(loop, group->end - 1, k, UNSOLVED, stop);
}
