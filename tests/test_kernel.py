"""A model that brings the C of its sampling: the FMU runs it, with the functions it calls, and hears its errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fmus.component import Signal, StepError
from fmus.export import cached_fmu
from fmus.fmu import load_fmu
from fmus.interface import interface
from fmus.model import Kernel, Model, ModelError
from fmus.python_export import build_python_fmu
from fmus.tracing import TraceError, trace

# m+ = (seen, d seen/dx in rows, x'), x+ = x + u; an error where u is negative.
SOURCE = """
static int kernel_sample(Instance *instance, double *xn, double *mn) {
    State *s = &instance->s;
    const double *m = s->v + M0, *u = s->v + U0, *p = s->v + P0;
    int i;
    if (u[0] < 0) return fail(instance, "'%s' wants to be positive", model_name[U0]);
    model_seen(s->v[0], s->v + X0, m, u, p, s->c, mn);
    model_seen_jacobian(s->v[0], s->v + X0, m, u, p, s->c, mn + 3);
    model_derivatives(s->v[0], s->v + X0, m, u, p, s->c, mn + 9);
    for (i = 0; i < NX; i++) xn[i] = s->v[X0 + i] + u[0];
    return OK;
}
"""


def seen(t, x, m, u, p):
    return {"product": p.k * x.a * x.b, "pair": np.array([x.a - u.u, t * x.b])}


def sample(t, x, m, u, p):
    values = seen(t, x, m, u, p)
    return {
        "seen": np.array([values["product"], *values["pair"]]),
        "slopes": np.array([[p.k * x.b, p.k * x.a], [1.0, 0.0], [0.0, t]]),
        "rates": np.array([-x.a, 0.0 * x.b]),
        "a": x.a + u.u,
        "b": x.b + u.u,
    }


MODEL = Model(
    name="kernelled",
    description="values, slopes and derivatives at each sampling",
    equations=lambda t, x, m, u, p: ({"a": -x.a, "b": 0.0 * x.b}, {}),
    inputs=(Signal("u"),),
    states=(Signal("a", start=2.0), Signal("b", start=3.0)),
    discrete=(Signal("seen", shape=(3,)), Signal("slopes", shape=(3, 2)), Signal("rates", shape=(2,))),
    parameters=(Signal("k", start=0.5), Signal("period", "s", 0.25)),
    sample=sample,
    sample_time="period",
    kernel=Kernel(SOURCE, {"seen": seen}),
)


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_fmu_runs_the_kernel_with_the_functions_it_calls(fmi):
    component = load_fmu(cached_fmu(MODEL, fmi))
    names = [signal.name for signal in component.outputs]
    component.start(0.0, np.array([0.1]))
    row = dict(zip(names, component.step(0.0, 0.25, np.array([0.1])), strict=True))
    a, b = 2.0 * np.exp(-0.25), 3.0
    wanted = [0.5 * a * b, a - 0.1, 0.25 * b, 0.5 * b, 0.5 * a, 1.0, 0.0, 0.0, 0.25, -a, 0.0]
    # RK4 at 1 ms.
    assert [row[name] for name in names if name[:4] in ("seen", "slop", "rate")] == pytest.approx(wanted, rel=1e-13)
    assert (row["a"], row["b"]) == pytest.approx((a + 0.1, b + 0.1), rel=1e-13)
    component.close()


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("kind", ["cs", "me"])
def test_an_error_of_the_kernel_ends_the_step_with_its_message(fmi, kind):
    component = load_fmu(cached_fmu(MODEL, fmi), kind=kind)
    component.start(0.0, np.array([0.1]))
    component.step(0.0, 0.25, np.array([0.1]))
    with pytest.raises(StepError, match="'u' wants to be positive"):
        component.step(0.25, 0.25, np.array([-0.1]))
    component.close()


def test_everything_sampled_depends_on_everything():
    found = interface(trace(MODEL))
    inputs = set(found.block("U"))
    for block in ("X", "M"):
        for reference in found.block(block):
            assert inputs <= set(found.variables[reference].dependencies or ())


def test_with_python_inside_the_twin_is_run(tmp_path):
    component = load_fmu(build_python_fmu("test_kernel", "MODEL", tmp_path / "kernelled.fmu"))
    native = load_fmu(cached_fmu(MODEL))
    for one in (component, native):
        one.start(0.0, np.array([0.1]))
    for k in range(4):
        rows = [
            dict(zip([s.name for s in one.outputs], one.step(0.25 * k, 0.25, np.array([0.1])), strict=True))
            for one in (component, native)
        ]
        assert rows[0] == pytest.approx(rows[1], rel=1e-12, abs=1e-15)
    component.close()
    native.close()


def test_a_kernel_without_its_twin_or_with_a_function_that_cannot_be_traced_is_refused():
    with pytest.raises(ModelError, match="bare: a kernel wants its twin, sample"):
        Model(name="bare", description="", equations=lambda t, x, m, u, p: ({}, {}), kernel=Kernel(SOURCE))
    stubborn = replace(MODEL, kernel=Kernel(SOURCE, {"seen": lambda t, x, m, u, p: {"one": float(x.a)}}))
    with pytest.raises(TraceError, match=r"kernelled\.seen: a symbol has no number"):
        trace(stubborn)
