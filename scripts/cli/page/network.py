"""The sections about the wire: how much plan the devices held, what was lost."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from headway.cli.page.packets import Statuses, statuses, summed
from headway.cli.page.plot import Array, Plot
from headway.cli.page.section import Rows, Section, Trace, levels, side_by_side
from headway.cli.page.shown import Shown
from headway.devices.core import COAST_KNOTS

COUNTS = {  # attributes of Statuses
    "plans_lost": "plans lost",
    "plans_late": "plans too late",
    "plans_refused": "plans refused",
    "frames_bad": "frames replayed or damaged",
    "statuses_lost": "statuses lost",
}


class Network:
    """What the packets of some runs tell, by run and device."""

    def __init__(self, shown: Sequence[Shown]) -> None:
        self._shown = shown
        self._of = {
            run: {
                axis.joint: statuses(run.arrays, device, run.config.loop.knot_us)
                for device, axis in enumerate(run.config.machine.boards)
            }
            for run in shown
        }

    def lead(self) -> Section:
        """How long each device could go on without the host."""

        section = Section(
            "lead",
            "Lead",
            [
                "How much of its plan a device still held when it sent a status. For so long it "
                "would have gone on, to rest, had the host fallen silent. Every plan that arrives "
                "fills it up; a lost one leaves a notch.",
                *(run.label(self._least_lead(run)) for run in self._shown),
            ],
        )
        section.plots = self._by_device(Plot("Lead", "lead [ms]"), "lead_s")
        return section

    def losses(self) -> Section:
        """What was lost on the wire, and what the devices did not take."""
        section = Section(
            "losses",
            "Losses",
            [
                "As the statuses since the task's beginning tell it. A plan is lost if the device "
                "never got it, a status if the host never did. What was lost after the last status "
                "is not known here.",
            ],
            table=self._table(),
        )
        happened = [
            name
            for name in COUNTS
            if any(self._total(run, name)[1][-1:].any() for run in self._shown)
        ]
        never = [text for name, text in COUNTS.items() if name not in happened]
        if never:
            section.about.append(f"There were no {', no '.join(never)}.")

        def counts(run: Shown) -> list[Trace]:
            return [Trace(COUNTS[name], *self._total(run, name), "steps") for name in happened]

        if happened:
            section.plots += side_by_side(self._shown, Plot("All devices", "frames"), counts)
        lines = levels(
            self._shown, "no new plans", lambda run: COAST_KNOTS * run.config.loop.knot_us * 1e-3
        )
        gaps = Plot("From status to status", "gap [ms]", levels=lines)
        section.plots += self._by_device(gaps, "gap_s")
        return section

    def _by_device(self, like: Plot, name: str) -> list[Plot]:
        """Plots of an attribute of Statuses in seconds, as milliseconds."""

        def traces(run: Shown) -> list[Trace]:
            return [
                Trace(joint, of.time_s, 1e3 * getattr(of, name))
                for joint, of in self._of[run].items()
            ]

        return side_by_side(self._shown, like, traces)

    def _total(self, run: Shown, name: str) -> tuple[Array, Array]:
        devices = self._of[run].values()
        return summed([of.time_s for of in devices], [getattr(of, name) for of in devices])

    def _least_lead(self, run: Shown) -> str:
        least = {}
        for joint, of in self._of[run].items():
            judged = (of.time_s >= run.span_s[0]) & np.isfinite(of.lead_s)
            if judged.any():
                least[joint] = f"{joint} {1e3 * of.lead_s[judged].min():.3g} ms"
        return f"Least after the entry: {', '.join(least.values())}." if least else "Not known."

    def _table(self) -> Rows:
        named = bool(self._shown[0].name)
        head = [*(["run"] if named else []), "device", *COUNTS.values(), "longest gap [ms]"]
        body = []
        for run in self._shown:
            for joint, of in self._of[run].items():
                counts = [_last(of, name) for name in COUNTS]
                gap = f"{1e3 * of.gap_s.max():.3g}" if len(of.gap_s) else "-"
                body.append([*([run.name] if named else []), joint, *counts, gap])
        return Rows(head, body, numbers=len(COUNTS) + 1)


def _last(of: Statuses, name: str) -> str:
    values = getattr(of, name)
    return str(int(values[-1])) if len(values) else "-"
