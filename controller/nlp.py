"""The nonlinear problem that a tick's quadratic program stands for, solved to convergence.

Offline: the program's cost and its linear constraints are the problem's own, so only the
linearized equations of motion are put back, and the task's own costs and rows. IPOPT: Waechter,
Biegler, Math. Prog. 106, 2006.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from headway.controller.equations import Equations
from headway.controller.prediction import ServoLaw, interval
from headway.controller.program import Program
from headway.models.codegen import among
from headway.models.machine import Machine

Array = NDArray[np.float64]


def converged(program: Program, machine: Machine, law: ServoLaw) -> tuple[Array, str]:
    """The solution in the variables of the last program, from whose answer it starts, and IPOPT's
    own word."""
    ocp, pool, n, costs = program.ocp, program.pool, program.ocp.n, program.ocp.costs
    step = interval(Equations(machine.tree))
    z = ca.MX.sym("z", ocp.size)
    whole = z * ocp.column_scale
    x = ca.DM(pool["x"]) + ca.reshape(whole[ocp.states], 2 * n, ocp.intervals + 1)
    steps = ca.reshape(whole[ocp.torques], len(ocp.driven), ocp.intervals + 1)
    u = ca.DM(pool["around"]) + among(steps, ocp.driven, n)
    ends = (x[:, :-1], u[:, :-1], u[:, 1:])
    constant = pool["d"], ocp.interval_s, law.parameters
    along = step.map(ocp.intervals, [False] * 3 + [True] * 3, [False] * 4)
    after = along(*ends, *constant)[0]
    motion = slice(2 * n, 2 * n * (ocp.intervals + 1))  # rows of the equations of motion
    scale = ocp.row_scale[motion]
    defect = ca.vec(x[:, 1:] - after) * scale
    others = np.r_[0 : motion.start, motion.stop : ocp.kept_rows.start]
    linear = ca.DM(program.constraints()[others])
    above = ca.MX(0, 1)
    half = ca.DM(ocp.hessian)
    hessian: Any = half + half.T - ca.diag(ca.diag(half))
    cost = ca.bilin(hessian, z, z) / 2
    gradient = pool["gradient"][:, 0].copy()
    if costs is not None:
        of_x = ocp.column_scale[ocp.states]
        gradient[ocp.states] -= of_x * pool["slope"].ravel(order="F")
        at = x, ca.DM(pool["time_s"]), ca.DM(np.linspace(0, 1, ocp.intervals + 1)).T
        cost += ca.sum2(_each(costs.value, *at, costs.parameters))
        x_later, time_s, share = (of[:, 1:] for of in at)
        kept = _each(costs.kept, x_later, time_s, share, costs.parameters)[0]
        above = ca.vec(kept) - whole[ocp.kept_slacks]
        blocks = ca.horzsplit(_each(costs.function, *at, costs.parameters)[0], 2 * n)
        of_states = ca.diag(ca.DM(of_x)) @ ca.diagcat(*blocks) @ ca.diag(ca.DM(of_x))
        rest = ocp.size - len(of_x)
        hessian += ca.diagcat(of_states, ca.MX(rest, rest))
    cost += ca.dot(ca.DM(gradient), z)
    problem: dict[str, Any] = {"x": z, "f": cost, "g": ca.vertcat(defect, linear @ z, above)}
    # The costs' own curvature, without the motion's: Gauss and Newton's. It stays convex.
    p, of_cost, of_rest = (ca.MX.sym(*of) for of in (("p", 0), ("f", 1), ("g", ocp.rows)))
    curvature = ca.Function("curvature", [z, p, of_cost, of_rest], [of_cost * ca.triu(hessian)])
    options: dict[str, Any] = {
        "print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-9,
        "hess_lag": curvature,
    }  # fmt: skip
    solver = ca.nlpsol("converged", "ipopt", problem, options)
    lower, upper = pool["lower"][others, 0], pool["upper"][others, 0]
    zero, free = np.zeros(len(scale)), np.full(above.numel(), -np.inf)
    solution = solver(
        x0=pool["z"],
        lbg=np.concatenate((zero, lower, free)),
        ubg=np.concatenate((zero, upper, np.zeros(len(free)))),
    )
    return np.array(solution["x"]).ravel(), str(solver.stats()["return_status"])


def _each(function: ca.Function, x: Any, time_s: Any, share: Any, parameters: Array) -> Any:
    """At every node, a column each."""
    every = function.map(x.shape[1], [False] * 3 + [True], [False] * function.n_out())
    return every(x, time_s, share, parameters)
