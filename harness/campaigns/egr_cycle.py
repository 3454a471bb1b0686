"""The drive cycle of the campaign `egr-sensors`: speed, wastegate and EGR valve over time.

Figure 3 of the paper is not at hand: what the text says of it is kept, speeds from 2400 to 4000 rpm, wastegate and
LP-EGR valve that move, EGR from 1.5 to 11 %; all else is chosen [I]. Steps of the valve take 200 ms, of the wastegate
300 ms, so that nothing asks for more than an actuator does.
"""

from __future__ import annotations

from collections.abc import Mapping

# time [s]: speed [rpm], straight between.
SPEED = {
    0.0: 3200, 4.0: 3200, 5.0: 2800, 8.5: 2800, 9.5: 2400, 14.0: 2400, 15.5: 3200, 19.0: 3200, 20.0: 3600,
    24.0: 3600, 25.0: 4000, 28.0: 4000, 29.0: 3600, 30.0: 3600,
}  # fmt: skip
# Begin of each step [s]: opening [mm], angle [deg].
_WASTEGATE_STEPS = {0.0: 11.6, 3.0: 13.0, 6.5: 15.0, 11.0: 12.5, 16.5: 14.0, 18.0: 11.6, 22.0: 15.0, 26.5: 16.0}
_VALVE_STEPS = {
    0.0: 10.0, 2.0: 14.0, 4.5: 8.0, 7.5: 12.0, 10.0: 18.5, 13.0: 11.0, 15.0: 6.0, 17.5: 10.0, 20.5: 14.0, 23.0: 8.0,
    25.5: 18.0, 28.0: 11.0,
}  # fmt: skip
WASTEGATE_TAKES, VALVE_TAKES = 0.3, 0.2


def stepped(steps: Mapping[float, float], takes: float) -> dict[float, float]:
    """Points joined by lines of what goes to each value from its time on, in `takes` [s]; held to 30 s."""
    points: dict[float, float] = {}
    last = next(iter(steps.values()))
    for begin, value in steps.items():
        points[begin] = last
        if begin > 0.0:
            points[round(begin + takes, 6)] = value
        last = value
    points[30.0] = last
    return points


WASTEGATE = stepped(_WASTEGATE_STEPS, WASTEGATE_TAKES)
EGR_VALVE = stepped(_VALVE_STEPS, VALVE_TAKES)


def source(points: Mapping[float, float], unit: str) -> str:
    """A source of points joined by lines, as campaign files have it."""
    times = ", ".join(f"{t:g} s" for t in points)
    values = ", ".join(f"{value:g} {unit}" for value in points.values())
    return f"{{use: source, unit: {unit}, table: {{time: [{times}], value: [{values}], between: linear}}}}"
