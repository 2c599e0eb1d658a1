"""Pages without a script, of calibrations and certificates: their shell, and their tables, notices and figures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from string import Template

from sylpose.report.page import compute_hash, escape_html, load_asset, render_row


@dataclass(frozen=True)
class StaticPage:
    """Content of a page.

    Attributes:
        kind: what it is, such as "calibration".
        title: name of the recording.
        facts: labels and texts below the title.
        notices: HTML from `render_notice`, in order.
        body: HTML of its sections, in order.
        notes: paragraphs of the footer, plain text.
        version: that made it.
    """

    kind: str
    title: str
    facts: Iterable[tuple[str, str]]
    notices: Sequence[str]
    body: Sequence[str]
    notes: Sequence[str]
    version: str

    def render(self) -> str:
        """Render the page as HTML text, which loads nothing."""
        style = load_asset("report.css") + load_asset("certificate.css")
        notes = [*self.notes, f"Made by sylpose {self.version}."]
        return Template(load_asset("static.html")).substitute(
            style=style,
            style_hash=compute_hash(style),
            version=escape_html(self.version),
            kind=escape_html(self.kind),
            title=escape_html(self.title),
            facts="".join(
                f"<div><dt>{escape_html(label)}</dt><dd>{escape_html(text)}</dd></div>" for label, text in self.facts
            ),
            notices="".join(self.notices),
            body="\n".join(self.body),
            notes="".join(f"<p>{escape_html(note)}</p>" for note in notes),
        )


def render_section(title: str, content: str, note: str = "") -> str:
    """Render a section; `content` is HTML, the note plain text."""
    text = f'<p class="note">{escape_html(note)}</p>' if note else ""
    return f'<section class="card"><h2>{escape_html(title)}</h2>{content}{text}</section>'


def render_table(header: Sequence[str], rows: Iterable[Sequence[str]], numbers: int, groups: str = "") -> str:
    """Render a table; after the first column come `numbers` columns of numbers, then ones of text.

    `groups` is the HTML of the cells above the header.
    """
    names = "".join(
        f"<th{' class=number' * (0 < i <= numbers)}>{escape_html(name)}</th>" for i, name in enumerate(header)
    )
    body = "".join(render_row(row, numbers) for row in rows)
    above = f"<tr>{groups}</tr>" if groups else ""
    return f'<div class="scroll"><table><thead>{above}<tr>{names}</tr></thead><tbody>{body}</tbody></table></div>'


def render_notice(title: str, sentences: Sequence[str]) -> str:
    """Render a notice with a list of sentences; "" without any."""
    if not sentences:
        return ""
    items = "".join(f"<li>{escape_html(sentence)}</li>" for sentence in sentences)
    return f'<div class="notices"><section class="notice"><h2>{escape_html(title)}</h2><ul>{items}</ul></section></div>'


def render_figure(title: str, size: tuple[float, float], drawn: Iterable[str], keys: str = "") -> str:
    """Render a figure of SVG elements, with a legend as HTML below it."""
    label, (width, height) = escape_html(title), size
    svg = f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="{label}">{"".join(drawn)}</svg>'
    legend = f'<div class="keys">{keys}</div>' if keys else ""
    return f'<figure class="card"><h3>{label}</h3>{svg}{legend}</figure>'
