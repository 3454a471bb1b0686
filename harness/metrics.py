"""The kinds of metric: what each is given, what its values are called, their units, and its version."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from harness import consistencymetrics, crankmetrics, diagnosismetrics, errormetrics, signalmetrics
from harness.arguments import Arguments, Errors, One, OneInTime, Result, Several, SignedError


@dataclass(frozen=True)
class Kind:
    """A function of arrays, the arguments it is given in a campaign, and what its values are by suffix.

    `version` is raised when a value comes to mean something else. A suffix with `{class}` stands for one a class.
    """

    function: Callable[..., Any]
    arguments: type[Arguments]
    results: Mapping[str, Result]
    version: int = 1

    @property
    def meaning(self) -> str:
        """What it measures, in the words of the function: equation, units, special cases."""
        return " ".join((self.function.__doc__ or "").split())


ERROR, SIGNAL, SHARE, SECONDS, DEGREES = Result("error"), Result("signal"), Result("1"), Result("s"), Result("deg")
COUNT = Result("count")
DELAYS = {
    "delay": Result("s", sampled=True),
    "delay_median": SECONDS,
    "delay_p95": SECONDS,
    "delay_cycles": Result("count", sampled=True),
    "delay_cycles_median": COUNT,
    "delay_cycles_p95": COUNT,
    "missed": COUNT,
}
CONSISTENCY = {
    "": SHARE,
    "ratio": SHARE,
    "within": SHARE,
    "lower": SHARE,
    "upper": SHARE,
    "samples": COUNT,
    "indefinite": COUNT,
}
CYCLES = {"cycles": COUNT, "dropped": DEGREES}

KINDS: Mapping[str, Kind] = {
    "rmse": Kind(errormetrics.rmse, Errors, {"": ERROR}),
    "max_error": Kind(errormetrics.max_error, Errors, {"": ERROR}),
    "bias": Kind(errormetrics.bias, SignedError, {"": ERROR}),
    "nrmse": Kind(errormetrics.nrmse, errormetrics.Normalised, {"": SHARE}),
    "share_within": Kind(errormetrics.share_within, errormetrics.Within, {"": SHARE}),
    "settling": Kind(errormetrics.settling, errormetrics.Settling, {"": SECONDS}),
    "convergence_rate": Kind(
        errormetrics.convergence_rate, errormetrics.Convergence, {"": Result("1/s"), "ratio": SHARE}
    ),
    "nees": Kind(consistencymetrics.nees, consistencymetrics.Nees, CONSISTENCY),
    "nis": Kind(consistencymetrics.nis, consistencymetrics.Nis, CONSISTENCY),
    "accuracy": Kind(diagnosismetrics.accuracy, diagnosismetrics.Discrete, {"": SHARE}),
    "detection": Kind(
        diagnosismetrics.detection,
        diagnosismetrics.DiscreteInTime,
        {
            **DELAYS,
            "changes": COUNT,
            "false_alarms": COUNT,
            "false_alarms_per_min": Result("1/min"),
            "accuracy": SHARE,
        },
        version=2,
    ),
    "alarm": Kind(
        diagnosismetrics.alarm,
        diagnosismetrics.Alarm,
        {
            **DELAYS,
            "faults": COUNT,
            "false_alarms": COUNT,
            "false_alarms_per_hour": Result("1/h"),
            "false_alarms_per_cycle": SHARE,
            "true_positive_rate": SHARE,
            "false_positive_rate": SHARE,
        },
        version=2,
    ),
    "confusion": Kind(
        diagnosismetrics.confusion,
        diagnosismetrics.Confused,
        {"accuracy": SHARE, "recall_{class}": SHARE, "precision_{class}": SHARE},
    ),
    "crank_average": Kind(
        crankmetrics.crank_average,
        crankmetrics.CrankAverage,
        {
            "": SIGNAL,
            "std": ERROR,
            "cov": SHARE,
            "windows": COUNT,
            "spread": ERROR,
            "cylinder_{cylinder}": SIGNAL,
        },
    ),
    "crank_error": Kind(
        crankmetrics.crank_error,
        crankmetrics.CrankError,
        {"": ERROR, "max": ERROR, "scatter": ERROR, **CYCLES},
    ),
    "harmonic": Kind(crankmetrics.harmonic, crankmetrics.Harmonic, {"": ERROR, "phase": DEGREES, **CYCLES}),
    "harmonic_error": Kind(
        crankmetrics.harmonic_error,
        crankmetrics.HarmonicError,
        {"": ERROR, "amplitude": ERROR, "phase": DEGREES, **CYCLES},
    ),
    "dwell_min": Kind(signalmetrics.dwell_min, OneInTime, {"": SECONDS}),
    "final": Kind(signalmetrics.final, One, {"": SIGNAL}),
    "minimum": Kind(signalmetrics.minimum, One, {"": SIGNAL}),
    "maximum": Kind(signalmetrics.maximum, One, {"": SIGNAL}),
    "mean": Kind(signalmetrics.mean, One, {"": SIGNAL}),
    "spread": Kind(signalmetrics.spread, Several, {"": ERROR, "final": ERROR}),
}
