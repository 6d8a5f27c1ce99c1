"""The page as one HTML file: text and tables here, plots and animation as data for page.js."""

from __future__ import annotations

import base64
import hashlib
import importlib.metadata
import json
from collections.abc import Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import Any

from headway.cli.page.animation import Animation
from headway.cli.page.axes import effort, estimate, position, tracking
from headway.cli.page.figures import tables
from headway.cli.page.network import Network
from headway.cli.page.plot import Plot
from headway.cli.page.scene import HEIGHT, WIDTH
from headway.cli.page.section import Rows, Section
from headway.cli.page.shown import Shown
from headway.cli.page.ticks import compute, solver
from headway.cli.page.verdict import incomplete, verdict

PARTS = Path(__file__).parent  # files that are put into the page
SPEEDS = {"0.1": "1/10", "0.25": "1/4", "0.5": "1/2", "1": "1", "2": "2"}


def document(shown: Sequence[Shown], film: Animation | None, no_film: str) -> str:
    """The page of one run, or of two to be compared.

    film: the animation; without one `no_film` says why.
    """
    network = Network(shown)
    sections = [
        tracking(shown),
        estimate(shown),
        position(shown),
        effort(shown),
        compute(shown),
        network.lead(),
        network.losses(),
        solver(shown),
    ]
    for section in sections:
        section.plots = [plot for plot in section.plots if not plot.empty]
    figures = tables(shown)
    links = [("run", "Run"), *((section.key, section.title) for section in sections)]
    style = _part("page.css") + _part("uplot/uPlot.min.css")
    scripts = _part("uplot/uPlot.iife.min.js"), _part("page.js")
    plots = [plot for section in sections for plot in section.plots]
    return Template(_part("page.html")).substitute(
        policy=_policy(style, *scripts),
        title=escape(" and ".join(run.name for run in shown if run.name) or _name(shown[0])),
        style=style,
        heading=escape(_heading(shown)),
        subtitle=escape(_subtitle(shown)),
        alarms="\n".join(_note(alarm) for run in shown if (alarm := incomplete(run))),
        film=_film(shown, film, no_film),
        verdicts="\n".join(_verdict(run) for run in shown),
        links="\n".join(f'<a href="#{key}">{escape(title)}</a>' for key, title in links),
        summary=_summary(figures),
        sections=_sections(sections),
        footer=_footer(shown),
        licence=_part("uplot/LICENSE"),
        data=_data(shown, film, plots),
        uplot=scripts[0],
        script=scripts[1],
    )


def _part(name: str) -> str:
    return (PARTS / name).read_text(encoding="utf-8")


def _policy(style: str, *scripts: str) -> str:
    """What the browser may do for this page: nothing but run what is in it."""

    def named(text: str) -> str:
        digest = hashlib.sha256(text.encode()).digest()
        return f"'sha256-{base64.b64encode(digest).decode()}'"

    return (
        f"default-src 'none'; script-src {' '.join(map(named, scripts))}; "
        f"style-src {named(style)}; base-uri 'none'; form-action 'none'"
    )


def _name(run: Shown) -> str:
    return f"{run.config.name}, {run.run.path.parent.name}"


def _heading(shown: Sequence[Shown]) -> str:
    if len(shown) == 1:
        return shown[0].config.name
    return " and ".join(run.name for run in shown)


def _subtitle(shown: Sequence[Shown]) -> str:
    told = []
    for run in shown:
        config = run.config
        told.append(
            f"{config.duration_s:g} s at {1e6 / config.loop.knot_us:.1f} Hz, margin "
            f"{config.loop.margin_us / 1000:g} ms, seed {run.run.seed}"
        )
    return " / ".join(dict.fromkeys(told))


def _note(text: str) -> str:
    return f'<p class="note">{escape(text)}</p>'


def _film(shown: Sequence[Shown], film: Animation | None, no_film: str) -> str:
    if film is None:
        return _note(f"No animation: {no_film}.")
    if len(shown) == 1:
        ghost = "its reference, where the two can be told apart"
    else:
        ghost = f"that of {shown[1].name}, where the two can be told apart"
    about = f"Solid: the machine{_of(shown[0])}, from its true positions. Translucent: {ghost}."
    if film.end_s < shown[0].arrays["truth_s"][-1] - 1:
        about += f" The first {film.end_s:.0f} s of the run."
    speeds = "".join(
        f'<option value="{value}"{" selected" if value == "1" else ""}>{text} x</option>'
        for value, text in SPEEDS.items()
    )
    return f"""<figure class="film">
<canvas id="film" width="{WIDTH}" height="{HEIGHT}" role="img" aria-label="the machine"></canvas>
<div class="controls">
<button id="play" type="button">Play</button>
<input id="time" type="range" min="{film.start_s}" max="{film.end_s}" step="any" aria-label="time">
<output id="clock"></output>
<select id="speed" aria-label="speed">{speeds}</select>
</div>
<figcaption>{escape(about)} A click in a plot takes it there; dragging zooms all plots.</figcaption>
</figure>"""


def _of(run: Shown) -> str:
    return f" of {run.name}" if run.name else ""


def _verdict(run: Shown) -> str:
    of_run = verdict(run)
    head = f'<span class="key {run.colour}"></span>{escape(run.name)}: ' if run.name else ""
    items = "\n".join(f"<li>{escape(sentence)}</li>" for sentence in of_run.sentences)
    return f"""<div class="verdict{" bad" if of_run.bad else ""}">
<h2>{head}{of_run.word}</h2>
<ul>
{items}
</ul>
</div>"""


def _summary(figures: list[Rows]) -> str:
    if not figures:
        return ""
    both = "\n".join(_rows(rows) for rows in figures)
    return f'<div class="tables">\n{both}\n</div>'


def _rows(rows: Rows) -> str:
    names = len(rows.body[0]) - rows.numbers

    def cells(tag: str, row: list[str]) -> str:
        return "".join(
            f"<{tag}{' class=name' if i < names else ''}>{escape(cell)}</{tag}>"
            for i, cell in enumerate(row)
        )

    body = "\n".join(f"<tr>{cells('td', row)}</tr>" for row in rows.body)
    return f"""<div class="scroll"><table class="data">
<thead><tr>{cells("th", rows.head)}</tr></thead>
<tbody>
{body}
</tbody>
</table></div>"""


def _sections(sections: list[Section]) -> str:
    texts, number = [], 0
    for section in sections:
        about = "\n".join(f'<p class="about">{escape(text)}</p>' for text in section.about)
        table = f'<div class="tables">{_rows(section.table)}</div>' if section.table else ""
        figures = []
        for plot in section.plots:
            figures.append(_figure(plot, number))
            number += 1
        texts.append(
            f"""<section id="{section.key}">
<h2>{escape(section.title)}</h2>
{about}
{table}
<div class="plots">
{"".join(figures)}
</div>
</section>"""
        )
    return "\n".join(texts)


def _figure(plot: Plot, number: int) -> str:
    title, figures = escape(plot.title), escape("; ".join(plot.figures))
    return f"""<figure class="plot">
<figcaption><h3>{title}</h3><span>{figures}</span></figcaption>
<div class="canvas" data-plot="{number}"></div>
</figure>
"""


def _footer(shown: Sequence[Shown]) -> str:
    lines = []
    for run in shown:
        versions = ", ".join(f"{name} {version}" for name, version in run.run.versions.items())
        lines.append(
            f"<p>{escape(run.name or 'This run')}: {escape(str(run.run.path))}, log_sha256 "
            f"{run.run.log_sha256}, by {escape(versions)}</p>"
        )
    version = importlib.metadata.version("headway")
    lines.append(f"<p>Page by headway {version}, plots by uPlot (MIT licence).</p>")
    return "\n".join(lines)


def _data(shown: Sequence[Shown], film: Animation | None, plots: list[Plot]) -> str:
    tree: dict[str, Any] = {
        "span": [min(run.span_s[0] for run in shown), max(run.span_s[1] for run in shown)],
        "whole": [0.0, max(float(run.arrays["truth_s"][-1]) for run in shown)],
        "film": None,
        "plots": [plot.tree() for plot in plots],
    }
    if film is not None:
        pictures = [base64.b64encode(picture).decode() for picture in film.pictures]
        tree["film"] = {"start": film.start_s, "fps": film.fps, "pictures": pictures}
    text = json.dumps(tree, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c")  # nothing in it may end the script
