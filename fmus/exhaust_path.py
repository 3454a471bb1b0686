"""What of each cylinder's air-fuel ratio reaches the sensor: the response of `fmus.plants.exhaust_afr` by harmonics.

About a uniform AFR everything between the cylinders and the sensor is linear in their deviations a_i, and once periodic

    afr_turbine - AFR = sum over k of c_k exp(i k theta/2),  c_k = sum over i of a_i G_i(k)

since the factor (1 + AFR)^2 from fuel fraction to AFR is the same at both ends. With four equal exhausts G_i(k) is
G(k/2) exp(-i k theta_i/2), theta_i the firing TDC. `path_response` has G in closed form, with the means over the cycle
of the mass in the manifold and of the flow out of it; `path_harmonics` has G_i with both as they pulsate.
Gains are complex, of exp(i k theta/2): a negative phase is late.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import newton

from fmus.plants.exhaust_afr import CELLS, CYCLE, CYLINDERS, FIRING, cell_mass, exhaust_profile, outflow
from fmus.turbocharger import turbine_pressure

STEPS = 720  # of RK4 in a cycle


class Breathing(NamedTuple):
    """Four equal exhausts: omega [rad/s], m_exh [kg] of each cylinder in a cycle, T_exh [K]. Numbers or symbols."""

    omega: Any
    m_exh: Any
    T_exh: Any


def profile_response(order: Any, p: Any) -> tuple[Any, Any]:
    """Gain [1], signed, and phase [rad] of the integral of exhaust_profile(theta) exp(-i order theta).

    gain = sinc(x) + sinc(x - pi)/2 + sinc(x + pi)/2, sinc(x) = sin(x)/x, x = order L/2; phase = -order (EVO + EVC)/2;
    `order` per revolution.
    """
    x = 0.5 * order * (p.EVC - p.EVO)
    return _sinc(x) + 0.5 * (_sinc(x - np.pi) + _sinc(x + np.pi)), -0.5 * order * (p.EVO + p.EVC)


def _sinc(x: Any) -> Any:
    zero = np.abs(x) < 1e-9
    return np.where(zero, 1.0, np.sin(x) / np.where(zero, 1.0, x))


def path_gain_and_phase(order: Any, at: Breathing, p: Any) -> tuple[Any, Any]:
    """Gain [1], signed, and phase [rad] of G(order), at `order` per revolution, in closed form.

        G = (1/4) F(order) 1/(1 + s m/W) 1/(1 + s m_c/W)^CELLS,  s = i order omega,  W = 4 m_exh omega/(4 pi)

    F as `profile_response`, m the mass in the manifold at the pressure at which the turbine passes W, m_c that in a
    cell of the pipe; `p` has the plant's parameters. It takes symbols, too.
    """
    W = 4.0 * at.m_exh * at.omega / CYCLE
    gain, phase = profile_response(order, p)
    mass = turbine_pressure(W, at.T_exh, p.p_t, p) * p.V_em / (p.R_e * at.T_exh)
    mixing = order * at.omega * mass / W
    cell = order * at.omega * cell_mass(at.T_exh, p) / W
    gain = 0.25 * gain / np.sqrt(1.0 + mixing**2) / (1.0 + cell**2) ** (0.5 * CELLS)
    return gain, phase - np.arctan(mixing) - CELLS * np.arctan(cell)


def path_response(order: Any, at: Breathing, p: Any) -> Any:
    """The complex gain G(order) of `path_gain_and_phase`, for numbers and arrays of them."""
    gain, phase = path_gain_and_phase(order, at, p)
    return gain * np.exp(1j * phase)


def sensor_response(order: Any, omega: Any, p: Any) -> Any:
    """The complex gain from `afr_turbine` to `afr_sensor`: 1/((1 + s tau_1)(1 + s tau_2)), s = i order omega."""
    s = 1j * order * omega
    return 1.0 / ((1.0 + s * p.tau_1) * (1.0 + s * p.tau_2))


def path_harmonics(
    count: int, omega: float, m_exh: NDArray[np.float64], T_exh: float, p: Any
) -> NDArray[np.complex128]:
    """G_i(k) of cylinder i in row i - 1 and harmonic k = 0 ... `count` of the cycle in column k, shape (4, count + 1).

    omega [rad/s], m_exh (4,) [kg] which may differ, T_exh [K], `p` with the plant's parameters. The manifold's mass is
    brought to its periodic course by shooting. Then z is linear with coefficients periodic in theta: with the
    transition matrix P over a cycle and b_i what cylinder i alone leaves at its end, (1 - P) x_i = b_i is where its
    response begins. Raises RuntimeError: no periodic course was found.
    """
    inflow = _inflow(omega, m_exh, p)
    around = _Cycle(inflow, T_exh, p, CYCLE / STEPS / omega)
    guess = turbine_pressure(inflow.mean(axis=0).sum(), T_exh, p.p_t, p) * p.V_em / (p.R_e * T_exh)
    mass = newton(lambda m: around.masses(m)[-1] - m, guess, tol=1e-12 * guess, rtol=1e-12)
    states = around.compositions(around.masses(mass))
    n = 1 + CELLS
    begin = np.linalg.solve(np.eye(n) - states[-1][:, :n], states[-1][:, n:])
    reached = states[:-1, -1, :n] @ begin + states[:-1, -1, n:]
    found: NDArray[np.complex128] = np.fft.fft(reached, axis=0)[: count + 1].T / STEPS
    return found


def _inflow(omega: float, m_exh: NDArray[np.float64], p: Any) -> NDArray[np.float64]:
    """Flows [kg/s] out of the cylinders at the beginning and the middle of each step, shape (2 STEPS + 1, 4)."""
    theta = np.linspace(0.0, CYCLE, 2 * STEPS + 1)
    return np.stack(
        [m * omega * exhaust_profile(theta - FIRING[i], p) for i, m in zip(CYLINDERS, m_exh, strict=True)], axis=1
    )


class _Cycle(NamedTuple):
    """A cycle in steps of h [s] with the cylinders' flows given at their ends and middles."""

    inflow: NDArray[np.float64]
    T_exh: float
    p: Any
    h: float

    def masses(self, begin: float) -> NDArray[np.float64]:
        """Masses in the manifold at the stages of RK4 and at the end, from that at the beginning: (4 STEPS + 1,)."""
        total, h, found, m = self.inflow.sum(axis=1), self.h, [], begin

        def rate(place: int, mass: float) -> float:
            return float(total[place] - outflow(mass, self.T_exh, self.p)[1])

        for place in range(0, 2 * STEPS, 2):
            second = m + 0.5 * h * (first := rate(place, m))
            third = m + 0.5 * h * (middle := rate(place + 1, second))
            fourth = m + h * (again := rate(place + 1, third))
            found += [m, second, third, fourth]
            m = m + h / 6.0 * (first + 2.0 * middle + 2.0 * again + rate(place + 2, fourth))
        return np.array([*found, m])

    def compositions(self, masses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Fuel in the manifold and z in the pipe after each step, shape (STEPS + 1, n, n + 4), n = 1 + CELLS.

        The first n columns are the transition matrix, the last four what each cylinder alone leaves, from nothing.
        """
        n, h = 1 + CELLS, self.h
        flows = outflow(masses, self.T_exh, self.p)[1]
        cells = flows / cell_mass(self.T_exh, self.p)
        x = np.hstack([np.eye(n), np.zeros((n, 4))])
        found = [x]

        def rate(stage: int, place: int, x: NDArray[np.float64]) -> NDArray[np.float64]:
            before = np.vstack([x[:1] / masses[stage], x[1:-1]])
            change = np.vstack([-flows[stage] * before[:1], cells[stage] * (before - x[1:])])
            change[0, n:] += self.inflow[place]
            return change

        for k in range(STEPS):
            stage, place = 4 * k, 2 * k
            first = rate(stage, place, x)
            second = rate(stage + 1, place + 1, x + 0.5 * h * first)
            third = rate(stage + 2, place + 1, x + 0.5 * h * second)
            fourth = rate(stage + 3, place + 2, x + h * third)
            x = x + h / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
            found.append(x)
        return np.array(found)
