/* Takes back what has no keep and restore in C of its own: parts without a state, parts written in Python. */

/* A part without a state: there is nothing to keep, and to go back is to do nothing. */
EXPORT int crankbench_stateless_keep(void *self)
{
    (void)self;
    return OK;
}

/* A part written in Python, by methods of its own. A call cannot pass on what is raised, so that it counts as FATAL
 * unless Python says otherwise at its last line. */
typedef struct {
    void (*keep)(void);
    void (*restore)(void);
    int64_t status;
} PythonPast;

EXPORT int crankbench_python_keep(void *self)
{
    PythonPast *past = (PythonPast *)self;
    past->status = FATAL;
    past->keep();
    return (int)past->status;
}

EXPORT int crankbench_python_restore(void *self)
{
    PythonPast *past = (PythonPast *)self;
    past->status = FATAL;
    past->restore();
    return (int)past->status;
}
