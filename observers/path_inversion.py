"""From the harmonics of what reaches a sensor back to the AFR of four cylinders: the path between in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmus.crankcycle import CYCLE

CYLINDERS = 4
INTERVAL = CYCLE / CYLINDERS  # deg
RADIANS = np.pi / 180.0  # rad/deg
RAISED_COSINE = float(np.sqrt(1.0 - 6.0 / np.pi**2))  # length of the even pulse that is spread alike, over its length


class Path(NamedTuple):
    """How AFR goes from the exhaust valves to a signal.

    Each cylinder's charge passes evenly over `pulse` [deg], the middle of which is `centre` [deg] after its firing top
    dead centre. It mixes with the time constant `mixing_time` [s] + `mixing_angle`/omega, arrives `delay_time` [s] +
    `delay_angle`/omega later, and goes through first-order lags of the time constants `lags` [s], those of a sensor.
    The delay is a true one, or that of so many `cells` in a row that each mix, where these are above 0.

    A pulse of another shape is much as an even one of the same centre and spread: a raised cosine over L as one of
    sqrt(1 - 6/pi^2) L = 0.626 L (`RAISED_COSINE`), for 240 deg to 1 % of the second harmonic and 6 % of the third.

    Of a manifold that holds the mass m at a flow W, the mixing takes m/W; where m stays as it is and the cylinders
    exhaust m_exh each, that is a crank angle, 180 deg m/m_exh. What goes with the gas is fixed in angle, what is a
    sensor's in time.
    """

    centre: Any
    pulse: Any
    mixing_time: Any = 0.0
    mixing_angle: Any = 0.0
    delay_time: Any = 0.0
    delay_angle: Any = 0.0
    lags: Sequence[Any] = ()
    cells: int = 0


class Phasor(NamedTuple):
    """A complex number `size` e^{i `angle`} in real terms; `size` may be negative, `angle` is in rad."""

    size: Any
    angle: Any


class Pattern(NamedTuple):
    """Four deviations d_i with zero sum as their transform over the firing order, places j = 0..3:

        D_1 = sum_j d_j (-i)^j = `one_real` + i `one_imaginary`,   D_2 = sum_j d_j (-1)^j = `two`

    D_3 is the conjugate of D_1, D_0 is 0.
    """

    one_real: Any
    one_imaginary: Any
    two: Any


def path_phasors(path: Path, omega: Any) -> list[Phasor]:
    """g_1, g_2, g_3: c_k = g_k D_k at the speed `omega` [rad/s], in the periodic steady state.

        g_k = 1/4 sin(x_k)/x_k e^{-i k W a_c/omega} e^{-i k W t_d}/(1 + i k W t_m) prod_j 1/(1 + i k W t_j)

    with W = omega/2 the frequency of the cycle, x_k = k pi pulse/720 deg, a_c = `centre`, t_m the mixing's and t_j the
    sensor's time constants, t_d the delay; of n cells 1/(1 + i k W t_d/n)^n stands for e^{-i k W t_d}. Pulses of 180
    deg are a staircase whose steps are the cylinders.
    """
    cycle = omega / 2.0
    mixing = path.mixing_time + path.mixing_angle * RADIANS / omega
    delay = path.delay_time + path.delay_angle * RADIANS / omega
    cells = [delay / max(path.cells, 1)] * path.cells
    found = []
    for k in range(1, CYLINDERS):
        x = k * np.pi * path.pulse / CYCLE
        size: Any = np.sin(x) / (4.0 * x)
        angle: Any = -k * path.centre * RADIANS / 2.0
        if not cells:
            angle = angle - k * cycle * delay
        for tau in (mixing, *cells, *path.lags):
            size = size / np.sqrt(1.0 + (k * cycle * tau) ** 2)
            angle = angle - np.arctan(k * cycle * tau)
        found.append(Phasor(size, angle))
    return found


def noise_sizes(inverted: Sequence[Any], memory: Any, omega: Any) -> list[Any]:
    """Standard deviations of c_1, c_2, c_3 over that of a coefficient of one cycle's white samples, (3,).

        s_k = sqrt(memory prod_j (1 + (k omega t_j/2)^2))

    where an observer took the lags t_j = `inverted` [s] off what the noise was added to. Over s_k harmonics and phasors
    have noise alike.
    """
    found = []
    for k in range(1, CYLINDERS):
        square: Any = memory
        for tau in inverted:
            square = square * (1.0 + (k * omega * tau / 2.0) ** 2)
        found.append(np.sqrt(square))
    return found


def locate(real: Sequence[Any], imaginary: Sequence[Any], phasors: Sequence[Phasor]) -> Pattern:
    """The deviations whose harmonics come nearest to c_1, c_2, c_3 (3,), in the sum of the squared distances.

        D_1 = (g_1* c_1 + g_3 c_3*)/(|g_1|^2 + |g_3|^2),   D_2 = Re(g_2* c_2)/|g_2|^2

    That is the least squares solution of six real equations for three unknowns, c_k = g_k sum_j d_j e^{-i k pi j/2};
    of white noise on w the one of least variance.
    """
    (g1, g2, g3), (r1, r2, r3), (i1, i2, i3) = phasors, real, imaginary
    first, third = _turned(r1, i1, -g1.angle), _turned(r3, -i3, g3.angle)
    both = g1.size**2 + g3.size**2
    return Pattern(
        (g1.size * first[0] + g3.size * third[0]) / both,
        (g1.size * first[1] + g3.size * third[1]) / both,
        _turned(r2, i2, -g2.angle)[0] / g2.size,
    )


def conditioning(phasors: Sequence[Phasor]) -> Any:
    """The condition number of the map from three degrees of freedom of the deviations to c_1, c_2, c_3, 1 or more.

    Its singular values are sqrt(2 (|g_1|^2 + |g_3|^2)), twice, and 2 |g_2|.
    """
    one = np.sqrt(2.0 * (phasors[0].size ** 2 + phasors[2].size ** 2))
    two = 2.0 * np.abs(phasors[1].size)
    return np.maximum(one, two) / np.minimum(one, two)


def pattern_of(deviations: Sequence[Any]) -> Pattern:
    """The pattern of what is left of values (4,), in firing order, when their mean is taken off."""
    first, second, third, fourth = deviations
    return Pattern(first - third, fourth - second, first - second + third - fourth)


def deviations_of(pattern: Pattern) -> list[Any]:
    """The deviations (4,), in firing order, of a pattern: d_j = (2 Re(D_1 i^j) + (-1)^j D_2)/4."""
    real, imaginary, two = pattern
    return [
        (2.0 * real + two) / 4.0,
        (-2.0 * imaginary - two) / 4.0,
        (-2.0 * real + two) / 4.0,
        (2.0 * imaginary - two) / 4.0,
    ]


def harmonics_of(deviations: Sequence[float], path: Path, omega: float) -> NDArray[np.complex128]:
    """c_1, c_2, c_3 of what reaches the signal, (3,), where the cylinders deviate by (4,) in firing order."""
    real, imaginary, two = pattern_of(deviations)
    found = path_phasors(path, omega)
    places = np.array([complex(real, imaginary), complex(two), complex(real, -imaginary)])
    return np.array([g.size * np.exp(1j * g.angle) for g in found]) * places


def _turned(real: Any, imaginary: Any, angle: Any) -> tuple[Any, Any]:
    """(real + i imaginary) e^{i angle}."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return real * cosine - imaginary * sine, real * sine + imaginary * cosine
