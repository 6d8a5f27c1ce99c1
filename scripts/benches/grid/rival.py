"""acados SQP-RTI on the same problem, in a process of its own.

Its wheel and CasADi's both have a libhpipm.so, so the two cannot share one. The wheel also brings
a `casadi` of its own, for another Python: it is unpacked beside the environment, not into it, and
acados' Python is run with ours. This file is both sides.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grid.reply import Reply, Watch

Array = NDArray[np.float64]
ROOT = Path(__file__).resolve().parents[3]
BUILD = ROOT / "build" / "acados"
PINNED = Path(__file__).with_name("acados.txt")
NO_LENGTH_S = 1e-9
FREE = 1e3  # rad and the like: a bound that is none
REST = 1e-5  # as controller/hpipm.cpp has it
TOLERANCE = 1e-4  # as controller/program.py has it for HPIPM


@dataclass(frozen=True)
class Settings:
    """Of acados: what its users tune."""

    integrator: str = "ERK"  # of four stages; IRK: Gauss-Legendre of one stage
    condensed: int = 0  # intervals of the QP after partial condensing; 0: all
    mode: str = "SPEED"  # HPIPM's
    warm: int = 0  # start of HPIPM: 0 cold, 1 warm, 2 hot
    newton: int = 1  # IRK's iterations


def source() -> Path:
    """What ACADOS_SOURCE_DIR is to be; unpacks the pinned wheel the first time."""
    folder = BUILD / "source"
    wheel = BUILD / "wheel"
    stamp, pinned = BUILD / "installed.txt", PINNED.read_text()
    if not stamp.exists() or stamp.read_text() != pinned:
        shutil.rmtree(BUILD, ignore_errors=True)
        pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", str(wheel)]
        subprocess.run([*pip, "-r", str(PINNED)], check=True)
        (folder / "interfaces" / "acados_template").mkdir(parents=True)
        for name in ("lib", "include", "bin"):
            (folder / name).symlink_to(wheel / "acados" / "install" / name)
        template = folder / "interfaces" / "acados_template" / "acados_template"
        template.symlink_to(wheel / "acados" / "acados_template")
        stamp.write_text(pinned)
    return folder


class Acados:
    """A contender whose work is done by the other process."""

    def __init__(self, problem: Any, intervals: int, knots: int, settings: Settings) -> None:
        here = source()
        environment = os.environ | {
            "ACADOS_SOURCE_DIR": str(here),
            "LD_LIBRARY_PATH": str(here / "lib"),
            "PYTHONPATH": f"{here / 'interfaces' / 'acados_template'}:{Path(__file__).parents[1]}",
        }
        self._process = subprocess.Popen(
            [sys.executable, "-c", "from grid.rival import serve; serve()"],
            env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip
        self._ask(("build", problem, intervals, knots, settings))

    def _ask(self, request: tuple[Any, ...]) -> Any:
        assert self._process.stdin is not None and self._process.stdout is not None
        pickle.dump(request, self._process.stdin)
        self._process.stdin.flush()
        try:
            return pickle.load(self._process.stdout)
        except EOFError:
            raise RuntimeError("acados' process ended: it says why above") from None

    def prepare(self, *known: Array) -> None:
        """As `Ours.prepare`."""
        self._ask(("prepare", *known))

    def feedback(self, start: Array) -> Any:
        """As `Ours.feedback`."""
        return self._ask(("feedback", start))

    def close(self) -> None:
        """Ends the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


class Solver:
    """acados' solver. Its state is [x; w], its control w's step to the next node, in the scales of
    controller/ocp.py; w is the motors' torque and the disturbance, since a plan under another
    disturbance is the same with as much less torque. A first stage of no length leads from the
    committed torque to the plan's first one: acados 0.2 takes all of the first state as given.

    Limits of acceleration and of the speed half-way between nodes are left out, which is to its
    advantage: its speeds are limited at the nodes.
    """

    def __init__(self, problem: Any, intervals: int, knots: int, settings: Settings) -> None:
        import casadi as ca
        from acados_template import AcadosModel, AcadosOcp, AcadosOcpSolver

        from headway.controller.ocp import Limits, Ocp
        from headway.models.dynamics import forward_dynamics, inverse_dynamics

        config, machine = problem.config(intervals, knots), problem.machine()
        self._ocp = of = Ocp(config, Limits.of(config))
        n, w_count, count = of.n, len(of.driven), intervals
        self._n, self._w, self._count = n, w_count, count
        scale_x = of.column_scale[: 2 * n]
        scale_w = of.column_scale[of.torques][:w_count]
        self._scale = np.concatenate((scale_x, scale_w))

        ocp, model = AcadosOcp(), AcadosModel()
        made_of = Path(__file__).read_text() + config.model_dump_json() + repr(settings)
        digest = hashlib.sha256(made_of.encode()).hexdigest()[:12]
        model.name = f"{problem.name}_{digest}"
        x, u = ca.SX.sym("x", 2 * n + w_count), ca.SX.sym("u", w_count)
        rate = ca.SX.sym("rate", 2 * n + w_count)
        state, slope = x * self._scale, rate * self._scale
        q, v = state[:n], state[n : 2 * n]
        w = ca.SX(n, 1)
        w[of.driven] = state[2 * n :]
        model.x, model.u, model.xdot = x, u, rate
        per_s = model.p = ca.SX.sym("per_s")  # one over the stage's length
        step = u * per_s  # the control is the step over the whole stage, in w's scale
        if settings.integrator == "ERK":
            motion = ca.vertcat(v, forward_dynamics(machine.tree, q, v, w)) / scale_x
            model.f_expl_expr = ca.cse(ca.vertcat(motion, step))
        else:
            effort = np.ones(n)
            effort[of.driven] = scale_w
            needed = inverse_dynamics(machine.tree, q, v, slope[n : 2 * n])
            model.f_impl_expr = ca.vertcat(
                rate[:n] - v / scale_x[:n], (needed - w) / effort, rate[2 * n :] - step
            )
        ocp.model = model
        ocp.dims.N = count + 1
        ocp.parameter_values = np.ones(1)
        self._costs(ocp)
        self._constraints(ocp)
        options = ocp.solver_options
        options.time_steps = np.array([NO_LENGTH_S, *count * [of.interval_s]])
        options.tf = float(sum(options.time_steps))
        self._lengths = options.time_steps
        options.qp_solver = "PARTIAL_CONDENSING_HPIPM"
        options.qp_solver_cond_N = min(settings.condensed or count + 1, count + 1)
        options.hessian_approx = "GAUSS_NEWTON"
        options.nlp_solver_type = "SQP_RTI"
        options.hpipm_mode = settings.mode
        options.qp_solver_warm_start = settings.warm
        options.qp_solver_iter_max = 30
        for name in ("stat", "eq", "ineq", "comp"):
            setattr(options, f"qp_solver_tol_{name}", TOLERANCE)
        options.integrator_type = settings.integrator
        options.sim_method_num_stages = 4 if settings.integrator == "ERK" else 1
        options.sim_method_newton_iter = settings.newton
        options.ext_fun_compile_flags = "-O3 -march=native"
        folder = BUILD / "generated" / model.name
        folder.mkdir(parents=True, exist_ok=True)
        os.chdir(folder)
        ocp.code_export_directory = str(folder / "code")
        new = not (folder / "built").exists()
        file = str(folder / "ocp.json")
        self._solver = AcadosOcpSolver(ocp, json_file=file, generate=new, build=new)
        (folder / "built").touch()
        self._set_constant()
        solve = getattr(self._solver.shared_lib, f"{self._solver.model_name}_acados_solve")
        from ctypes import c_int, c_void_p

        solve.argtypes, solve.restype = [c_void_p], c_int
        self._solve = solve

    def _costs(self, ocp: Any) -> None:
        w, nx = self._w, 2 * self._n + self._w
        self._hessian = self._ocp.stages()[1]
        cost = ocp.cost
        cost.cost_type = cost.cost_type_e = "LINEAR_LS"
        cost.Vx, cost.Vu = np.eye(nx + w, nx), np.eye(nx + w, w, -nx)
        cost.W, cost.yref = np.eye(nx + w), np.zeros(nx + w)
        cost.Vx_e, cost.W_e, cost.yref_e = np.eye(nx), np.eye(nx), np.zeros(nx)
        soft = len(self._ocp.bounded)
        for name in ("zl", "zu", "zl_e", "zu_e"):
            setattr(cost, name, np.zeros(soft))
        for name in ("Zl", "Zu", "Zl_e", "Zu_e"):
            setattr(cost, name, np.ones(soft))

    def _constraints(self, ocp: Any) -> None:
        n, w, bounded = self._n, self._w, self._ocp.bounded
        soft, c = len(bounded), ocp.constraints
        c.x0 = np.zeros(2 * n + w)
        boxes = np.append([n + axis for axis in self._ocp.driven], np.arange(2 * n, 2 * n + w))
        c.idxbx, c.lbx, c.ubx = boxes, -np.ones(2 * w), np.ones(2 * w)
        c.idxbx_e, c.lbx_e, c.ubx_e = boxes, -np.ones(2 * w), np.ones(2 * w)
        ahead = np.zeros((soft, 2 * n + w))
        for row, axis in enumerate(bounded):
            ahead[row, axis] = self._scale[axis]
            ahead[row, n + axis] = self._ocp.limits.approach_s[axis] * self._scale[n + axis]
        if soft:
            c.C, c.D, c.C_e = ahead, np.zeros((soft, w)), ahead
            c.lg = c.lg_e = -np.ones(soft)
            c.ug = c.ug_e = np.ones(soft)
            c.idxsg = c.idxsg_e = np.arange(soft)

    def _set_constant(self) -> None:
        """The weights, which are the Hessian's: acados halves the squares, too."""
        n, count, solver = self._n, self._count, self._solver
        state, torque, step = self._hessian
        soft = 2 * self._ocp.stages()[2][1][self._ocp.bounded]
        nothing, last = np.zeros(self._w), count + 1
        for i in range(last + 1):
            node = i - 1
            if i == 0:
                weights = [np.zeros(2 * n), nothing, torque[:, 0]]
            else:
                weights = [state[:, node], torque[:, node] if node else nothing]
                weights += [step[:, node]] if i < last else []
            # Rates of cost: it multiplies by the stage's length, but at the end.
            length = self._lengths[i] if i < last else 1.0
            solver.cost_set(i, "W", np.diag(np.concatenate(weights)) / length, api="new")
            for name in ("Zl", "Zu") if len(soft) else ():
                solver.cost_set(i, name, soft / length)
            if i < last:
                solver.set(i, "p", np.array([1 / length]))

    def prepare(
        self, x: Array, u: Array, d: Array, reference: Array, committed: Array, holding: Array
    ) -> None:
        """As `Ours.prepare`, but that x and u are not free any more."""
        n, count, solver, of = self._n, self._count, self._solver, self._ocp
        scale = self._scale
        driven = of.driven
        self._d = d[driven]
        low, high = soft_limits(of, x[:n, 0])
        clipped = np.clip(reference[:n], low, high)
        still = np.where(clipped == reference[:n], reference[n:], 0)
        wanted = np.vstack((clipped, still)) / scale[: 2 * n, None]
        guess = np.vstack((x, (u + d[:, None])[driven])) / scale[:, None]
        target = torque_targets(of, (holding + d)[driven], d[driven]) / scale[2 * n :, None]
        self._committed = (committed + d)[driven] / scale[2 * n :]
        first = np.concatenate((guess[: 2 * n, 0], self._committed))
        for i, node in enumerate([0, *range(count + 1)]):
            here = guess[:, node] if i else first
            solver.set(i, "x", here)
            y = [wanted[:, node], target[:, node]]
            if i <= count:
                after = guess[:, node + 1] if i else guess[:, 0]
                solver.set(i, "u", after[2 * n :] - here[2 * n :])
                y.append(np.zeros(self._w))
            solver.set(i, "yref", np.concatenate(y))
            if i:
                self._bound(i, node, d[driven])
            if len(of.bounded):
                wide = 0.0 if node else FREE
                solver.constraints_set(i, "lg", low[of.bounded, node] - wide)
                solver.constraints_set(i, "ug", high[of.bounded, node] + wide)
        self._bound_start(x[:, 0])
        solver.options_set("rti_phase", 1)
        with Watch() as self._preparation:
            self._solve(solver.capsule)
        self._linearize_us = float(solver.get_stats("time_lin")[0]) * 1e6

    def _bound(self, stage: int, node: int, d: Array) -> None:
        n, limits, scale = self._n, self._ocp.limits, self._scale
        speed = limits.velocity / scale[n : 2 * n][self._ocp.driven]
        if node == 0:  # it is as it is
            speed = np.full(self._w, FREE)
        elif node >= self._count - 1:
            speed = np.full(self._w, REST)
        torque = limits.torque[node]
        above = np.concatenate((speed, (torque + d) / scale[2 * n :]))
        below = np.concatenate((-speed, (d - torque) / scale[2 * n :]))
        self._solver.constraints_set(stage, "lbx", below)
        self._solver.constraints_set(stage, "ubx", above)

    def _bound_start(self, start: Array) -> None:
        at = np.concatenate((start / self._scale[: 2 * self._n], self._committed))
        self._solver.set(0, "lbx", at)
        self._solver.set(0, "ubx", at)

    def feedback(self, start: Array) -> Any:
        """As `Ours.feedback`."""
        n, solver = self._n, self._solver
        self._bound_start(start)
        solver.options_set("rti_phase", 2)
        with Watch() as watch:
            status = self._solve(solver.capsule)
        nodes = np.array([solver.get(i + 1, "x") for i in range(self._count + 1)]).T
        nodes *= self._scale[:, None]
        iterations = int(solver.get_stats("qp_iter")[-1])
        good = status == 0 and iterations < 30
        torques = np.zeros((n, self._count + 1))
        torques[self._ocp.driven] = nodes[2 * n :] - self._d[:, None]
        reply = Reply(nodes[: 2 * n], torques, good, iterations)
        for name, of in (("prepare", self._preparation), ("feedback", watch)):
            reply.cpu[name], reply.wall[name] = of.cpu, of.wall
        reply.cpu["linearize"] = reply.wall["linearize"] = self._linearize_us
        return reply


def soft_limits(ocp: Any, position: Array) -> tuple[Array, Array]:
    """Soft position limits at the nodes, (n, N+1) each, as `Ocp._soft_limits` has them."""
    from headway.controller.ocp import RETURN_S

    limits, times_s = ocp.limits, np.arange(ocp.intervals + 1) * ocp.interval_s
    fade = np.exp(-times_s / RETURN_S)
    low, high = limits.soft_min, limits.soft_max
    return (
        low[:, None] + np.outer(np.minimum(position - low, 0), fade),
        high[:, None] + np.outer(np.maximum(position - high, 0), fade),
    )


def torque_targets(ocp: Any, holding: Array, d: Array) -> Array:
    """(n, N+1): where the torque's own weight pulls it, by node."""
    target = np.repeat(d[:, None], ocp.intervals + 1, axis=1)
    target[:, -2:] = holding[:, None]
    return target


def serve() -> None:
    """The other process: answers until its input ends."""
    source, sink = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # acados prints what it does
    solver: Solver | None = None
    while True:
        try:
            what, *arguments = pickle.load(source)
        except EOFError:
            return
        if what == "build":
            solver, answer = Solver(*arguments), None
        else:
            answer = getattr(solver, what)(*arguments)
        pickle.dump(answer, sink)
        sink.flush()
