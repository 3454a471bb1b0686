"""The section `report` of the campaign `egr-sensors`: figures, histograms, what was published, rankings, selection."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

from fmus.plants.turbo_si_egr import SENSORS
from harness.campaigns.egr_noise import (
    AFTER,
    EKF_SETS,
    FAMILIES,
    LASTING,
    MODEL,
    OWN_SETS,
    PARAMETER_SET,
    POINT,
    SETS,
    Estimated,
    Set,
    named,
    titled,
)


def report(found: Estimated) -> Iterator[str]:
    """The lines of the section."""
    yield "report:"
    yield "  observers:"
    yield "    model: {title: Nonlinear model alone, metrics: [rmse_model, max_model]}"
    for kind, family in FAMILIES.items():
        for members in SETS:
            part = named(kind, members)
            yield f"    {part}: {{title: '{titled(members)}, {family.title}', metrics: [rmse_{part}, max_{part}]}}"
    for members in OWN_SETS:
        part = named("own", members)
        yield f"    {part}: {{title: '{titled(members)}, at rest', metrics: [rmse_{part}, max_{part}]}}"
    for members in EKF_SETS:
        part = named("ekf", members)
        yield f"    {part}: {{title: 'EKF, {titled(members)}', metrics: [rmse_{part}, max_{part}]}}"
    yield from _figures()
    yield from _histograms()
    yield from _published(found)
    yield from _rankings(found)
    yield from _selection(found)


SINGLES: tuple[Set, ...] = ((), *((name,) for name in SENSORS))
PAIRS: tuple[Set, ...] = tuple(combinations(SENSORS, 2))
OPTIMAL: tuple[Set, ...] = ((), ("EGR_DP",), ("EGR_DP", "MAFa"), ("EGR_DP", "MAFa", "MAFh"), SENSORS)


def _figures() -> Iterator[str]:
    yield "  figures:"
    yield "    - {title: 'The cycle (Figure 3): speed', experiment: cycle, traces: [[N.value]], unit: rpm}"
    yield "    - {title: 'The cycle (Figure 3): wastegate', experiment: cycle, traces: [[wastegate.value]], unit: mm}"
    yield "    - {title: 'The cycle (Figure 3): EGR valve', experiment: cycle, traces: [[egr_valve.value]], unit: deg}"
    yield "    - {title: 'EGR rate', experiment: cycle, traces: [[plant.egr_ratio]], unit: '%'}"
    yield "    - {title: 'Load (Figure 4)', experiment: cycle, traces: [[plant.IMEP]], unit: bar}"
    yield "    - title: Charge flow by speed-density (Figure 2)"
    yield "      experiment: cycle"
    yield "      traces: [[plant.W_cyl, model.W_cyl, kf_none.W_cyl]]"
    yield "      unit: g/s"
    for title, sets, begin, end in (
        ("one sensor at most (Figure 9A)", SINGLES, None, None),
        ("one sensor at most, 500 ms of a step of the valve (Figure 9B)", SINGLES, 13.0, 13.5),
        ("two sensors (Figure 11)", PAIRS, None, None),
        ("the best of each size by expectation of the paper (Figure 14)", OPTIMAL, None, None),
    ):
        yield f"    - title: Burnt fraction with {title}"
        yield "      experiment: cycle"
        shown = ", ".join(f"{named('kf', members)}.F_im" for members in sets)
        yield f"      traces: [[plant.F_im, {shown}]]"
        yield "      unit: '%'"
        if begin is not None:
            yield f"      from: {begin:g} s"
            yield f"      to: {end:g} s"


def _histograms() -> Iterator[str]:
    yield "  histograms:"
    for title, sets in (
        ("One sensor at most (Figure 10)", SINGLES),
        ("Two sensors (Figure 13)", PAIRS),
        ("The paper's best of each size (Figure 16)", OPTIMAL),
    ):
        pairs = ", ".join(f"[plant.F_im, {named('kf', members)}.F_im]" for members in sets)
        yield f"    - title: {title}"
        yield f"      pairs: [{pairs}]"
        yield "      experiments: [cycle]"
        yield f"      from: {AFTER}"
        yield "      unit: '%'"


# Table 6, Table 5 and the text of Sections 3.4.1 to 3.4.3: RMSE and largest error [%]; that without sensors is from
# "reduces the RMSE by 47.4 %".
PUBLISHED_ERRORS: dict[Set, tuple[float | None, float | None]] = {
    (): (0.947, 1.744),
    ("EGR_DP",): (0.498, 1.014),
    ("MAFa",): (0.909, 1.684),
    ("MAFh",): (0.935, 1.724),
    ("MAF",): (0.935, 1.724),
    ("EGR_DP", "MAFa"): (0.369, 0.754),
    ("EGR_DP", "MAFh"): (None, 0.794),
    ("EGR_DP", "MAF"): (None, 0.804),
    ("MAFa", "MAFh"): (None, 1.564),
    ("MAFa", "MAF"): (None, 1.594),
    ("MAFh", "MAF"): (None, 1.724),
    ("EGR_DP", "MAFa", "MAFh"): (0.367, None),
    SENSORS: (0.367, None),
}
# Sections 3.4.1 to 3.4.3, in words: what is said, and where it holds.
STATEMENTS = (
    ("EGR-DP is the best single sensor: better than MAFa", "rmse_kf_EGR_DP", "<", "rmse_kf_MAFa"),
    ("... than MAFh", "rmse_kf_EGR_DP", "<", "rmse_kf_MAFh"),
    ("... than MAF", "rmse_kf_EGR_DP", "<", "rmse_kf_MAF"),
    ("MAFa is the second single sensor: better than MAFh", "rmse_kf_MAFa", "<", "rmse_kf_MAFh"),
    ("EGR-DP + MAFa is the best pair: better than EGR-DP + MAFh", "rmse_kf_EGR_DP_MAFa", "<", "rmse_kf_EGR_DP_MAFh"),
    ("... than EGR-DP + MAF", "rmse_kf_EGR_DP_MAFa", "<", "rmse_kf_EGR_DP_MAF"),
    ("EGR-DP + MAFa is better than EGR-DP alone", "rmse_kf_EGR_DP_MAFa", "<", "rmse_kf_EGR_DP"),
    ("MAFa + MAFh is worse than EGR-DP alone", "rmse_kf_MAFa_MAFh", ">", "rmse_kf_EGR_DP"),
    ("MAFa + MAF is worse than EGR-DP alone", "rmse_kf_MAFa_MAF", ">", "rmse_kf_EGR_DP"),
    ("MAFh + MAF is worse than EGR-DP alone", "rmse_kf_MAFh_MAF", ">", "rmse_kf_EGR_DP"),
    ("a third sensor is worth less than 1 %", "rmse_kf_EGR_DP_MAFa_MAFh", ">", "0.99 * rmse_kf_EGR_DP_MAFa"),
    ("... and takes nothing away", "rmse_kf_EGR_DP_MAFa_MAFh", "<=", "1.01 * rmse_kf_EGR_DP_MAFa"),
    ("EGR-DP lowers the error of the model alone by 47 %", "rmse_kf_EGR_DP", "<", "0.53 * rmse_kf_none"),
    ("EGR-DP lowers the largest error by 42 %", "max_kf_EGR_DP", "<", "0.58 * max_kf_none"),
)  # fmt: skip
# Section 3.4.3: by how much the expected error falls with EGR-DP, with MAFa to it, with MAFh to both [%].
FALLS = ((12.2, 23.2), (8.9, 16.9), (0.3, 0.5))


def _published(found: Estimated) -> Iterator[str]:
    yield "  published:"
    for members, (rmse, largest) in PUBLISHED_ERRORS.items():
        for value, metric, what in ((rmse, "rmse", "RMSE"), (largest, "max", "largest error")):
            if value is not None:
                where = f"metric: {metric}_{named('kf', members)}, experiment: cycle"
                yield f"    - {{what: '{what} with {titled(members)}', published: '{value:g} %', {where}}}"
    for said, left, comparison, right in STATEMENTS:
        factor, _, name = right.rpartition(" * ")
        bound = f"{factor} * median({name})" if factor else f"median({name})"
        holds = f"holds: median({left}) {comparison} {bound}"
        yield f"    - {{what: '{said}', published: 'yes', experiment: cycle, {holds}}}"
    for (error, trace), before, after in zip(FALLS, OPTIMAL, OPTIMAL[1:], strict=False):
        ours = ", ".join(
            f"{100.0 * (1.0 - values[after] / values[before]):.1f} % ({by})" for by, values in found.expected.items()
        )
        yield f"    - what: 'expected error falls from {titled(before)} to {titled(after)}'"
        yield f"      published: {error:g} % (its power, trace(T), {trace:g} %)"
        yield f"      ours: '{ours}'"
    yield "    - what: largest error of the charge flow by speed-density, linear model (Figure 2)"
    yield "      published: 5.1 % of the flow"
    yield "      metric: charge_max_kf_none"
    yield "      experiment: cycle"
    yield "      note: the mean flow is that of the metric charge"


def _rankings(found: Estimated) -> Iterator[str]:
    yield "  rankings:"
    for kind, family in FAMILIES.items():
        yield f"    - title: Does the expected error rank the sets as the simulated one? {family.title.capitalize()}"
        yield "      metric: 'rmse_{observer}'"
        yield "      experiments: [cycle]"
        yield "      measures:"
        for by in found.expected if kind == next(iter(FAMILIES)) else [family.by]:
            expected = found.expected[by]
            for name, title, sets in (("all", "", SETS), ("pairs", ", two sensors (Figure 12)", PAIRS)):
                values = ", ".join(f"{named(kind, m)}: {100.0 * expected[m]:.6g}" for m in sets)
                yield f"        {by}_{name}: {{title: 'expected error [%], {by}{title}', values: {{{values}}}}}"


def _selection(found: Estimated) -> Iterator[str]:
    yield "  selection:"
    yield f"    target: {MODEL}"
    yield f"    set: {PARAMETER_SET}"
    yield f"    at: [{', '.join(POINT)}]"
    yield "    about: *about"
    yield "    estimate: [F_im]"
    yield f"    max_sensors: {len(SENSORS)}"
    yield "    method: h2"
    yield f"    noise: {{{', '.join(f'{name}: {value}' for name, value in found.noise.items())}}}"
    yield f"    period: {LASTING}"
    yield "    process: *published"
