/* Takes a part written in Python back: its own keep and restore, called from C. */
#include <stdint.h>

/* A call cannot pass on what is raised, so that it counts as FATAL unless Python says otherwise at its last line. */
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
