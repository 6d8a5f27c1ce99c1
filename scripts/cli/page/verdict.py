"""What a person wants to know of a run first: did it go well, and if not, what did not."""

from __future__ import annotations

from dataclasses import dataclass

from headway.cli.page.shown import Shown


@dataclass(frozen=True)
class Verdict:
    """`word` is about the whole; `bad` says that something is not as it should be."""

    word: str
    bad: bool
    sentences: list[str]


def verdict(run: Shown) -> Verdict:
    """Judged by what `headway run` judges a run by."""
    summary, trouble = run.summary, list[str]()
    if summary is None:
        return Verdict("Incomplete", True, ["A run without an end has no summary."])
    trouble += [f"Limit violated: {violation}." for violation in summary["limits_violated"]]
    if not summary["at_rest_after_end"]:
        trouble.append("The machine did not come to rest after the end.")
    word = "Not as it should be" if trouble else "Within all limits"
    if not run.run.complete:
        word = "Incomplete"
    ticks, rejected = summary["solver"]["ticks"], summary["solver"]["rejected"]
    rms, units = summary["tracking"]["rms"], summary["tracking"]["unit"]
    followed = ", ".join(
        f"{joint} within {value:.3g} {unit} rms"
        for joint, value, unit in zip(run.joints, rms, units, strict=True)
        if value is not None
    )
    good = [f"Followed its reference: {followed}."] if followed else []
    good.append(
        f"{rejected} of {ticks} plans rejected, {summary['deadline_misses']} deadlines missed."
    )
    if not trouble:
        good.append("At rest after the end.")
    return Verdict(word, bool(trouble) or not run.run.complete, trouble + good)


def incomplete(run: Shown) -> str:
    """What the record misses, in a sentence; "" if nothing."""
    if run.run.complete:
        return ""
    if dropped := run.run.batches_dropped:
        return run.label(
            f"The record is incomplete: {dropped} batches were dropped, its writer was too slow."
        )
    return run.label(
        "The record is incomplete: the run was killed, is still going on, or its file was cut off. "
        "This is what there is of it."
    )
