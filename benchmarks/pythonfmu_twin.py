"""The driveline as a PythonFMU slave: the same equations, the same RK4, crossings located by the same bisection."""

import math
from typing import Any

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Integer, Real

RPM = 30.0 / math.pi
State = tuple[float, float, float]


class Twin(Fmi2Slave):
    """Theta_e, omega_c, omega_p in SI, location 1 to 3, y in rpm, all deviations; input T_eng in N.m."""

    def __init__(self, **arguments: Any) -> None:
        super().__init__(**arguments)
        self.tau, self.J_e, self.J_v, self.B_e, self.b_sm = 0.125, 0.15, 80.0, 0.05, 40.0
        self.k, self.k_1, self.theta_e0, self.theta_1 = 1500.0, 5000.0, 0.025, 0.015
        self.theta_e = self.omega_c = self.omega_p = self.y = self.T_eng = 0.0
        self.location = 3
        for name in ("tau", "J_e", "J_v", "B_e", "b_sm", "k", "k_1", "theta_e0", "theta_1"):
            fixed = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.tunable}
            self.register_variable(Real(name, **fixed))
        self.register_variable(Real("T_eng", causality=Fmi2Causality.input))
        for name in ("theta_e", "omega_c", "omega_p", "y"):
            self.register_variable(Real(name, causality=Fmi2Causality.output))
        self.register_variable(Integer("location", causality=Fmi2Causality.output))

    def _derivatives(self, theta_e: float, omega_c: float, omega_p: float) -> State:
        slope = self.k if self.location == 2 else self.k_1
        beyond = (self.k_1 - self.k) * self.theta_1 * (2 - self.location)
        slip = self.tau * omega_c - omega_p
        torque = slope * (theta_e + self.theta_e0) + beyond - self._equilibrium + self.b_sm * slip
        return slip, (self.T_eng - self.B_e * omega_c - self.tau * torque) / self.J_e, torque / self.J_v

    def _rk4(self, x: State, h: float) -> State:
        a, b, c = x
        a1, b1, c1 = self._derivatives(a, b, c)
        a2, b2, c2 = self._derivatives(a + 0.5 * h * a1, b + 0.5 * h * b1, c + 0.5 * h * c1)
        a3, b3, c3 = self._derivatives(a + 0.5 * h * a2, b + 0.5 * h * b2, c + 0.5 * h * c2)
        a4, b4, c4 = self._derivatives(a + h * a3, b + h * b3, c + h * c3)
        sixth = h / 6.0
        return (
            a + sixth * (a1 + 2.0 * a2 + 2.0 * a3 + a4),
            b + sixth * (b1 + 2.0 * b2 + 2.0 * b3 + b4),
            c + sixth * (c1 + 2.0 * c2 + 2.0 * c3 + c4),
        )

    def _location_of(self, x: State) -> int:
        theta = x[0] + self.theta_e0
        return 1 + (theta + self.theta_1 > 0) + (theta - self.theta_1 > 0)

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Advance by one step."""
        high_side, low_side = max(self.theta_e0 - self.theta_1, 0.0), min(self.theta_e0 + self.theta_1, 0.0)
        self._equilibrium = self.k * self.theta_e0 + (self.k_1 - self.k) * (high_side + low_side)
        x, left = (self.theta_e, self.omega_c, self.omega_p), step_size
        while True:
            x1 = self._rk4(x, left)
            if self._location_of(x1) == self.location:
                break
            low, high = 0.0, left
            while high - low > 1e-13 * max(left, abs(current_time)) + 1e-15:
                middle = low + 0.5 * (high - low)
                if self._location_of(self._rk4(x, middle)) == self.location:
                    low = middle
                else:
                    high = middle
            x1 = self._rk4(x, high)
            self.location = self._location_of(x1)
            left -= high
            if not left > 0:
                break
            x = x1
        self.theta_e, self.omega_c, self.omega_p = x1
        self.y = RPM * self.omega_c
        return True
