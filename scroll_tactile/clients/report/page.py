"""A page: one HTML file that needs nothing else, no network and no script."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal

from scroll_tactile.clients.report.drawing import brief, shown
from scroll_tactile.errors import InputError

__all__ = ["Card", "State", "cards", "figure", "lines", "name_of", "note", "page", "require_page", "save", "table"]

State = Literal["good", "look", "bad", "none"]
Card = tuple[State, str, str, str]
"""How it stands, a heading, the answer in few words, and a sentence more."""

LONG = 40  # rows, from which on a table scrolls inside itself, and says so
# Sections of one figure or table, two of which stand side by side; one of which the table stands beside the picture.
KINDS = dict.fromkeys(("when", "health", "time", "holds"), ' class="half"') | {"channels": ' class="beside"'}

SIGNS = {"good": ("✓", "fine"), "look": ("!", "look at it"), "bad": ("✕", "bad"), "none": ("–", "not measured")}

# The palette is Okabe and Ito's (2008), which the colour-blind distinguish; lighter on dark. A table that is wider than
# its place has a shade at the end behind which it goes on.
STYLE = """
:root{color-scheme:light dark;--paper:#fcfcfa;--ink:#1c2126;--soft:#5b6570;--line:#dfe2e4;--card:#fff;
--blue:#0067a8;--red:#c04a00;--green:#00795a;--band:#eef2f5;--shade:#0004}
@media (prefers-color-scheme:dark){:root{--paper:#14181c;--ink:#e8eaec;--soft:#a3adb6;--line:#363d44;--card:#1c2228;
--blue:#63b3ea;--red:#f2924e;--green:#3fc59b;--band:#232a31;--shade:#fff4}}
*{box-sizing:border-box}
body{margin:0 auto;max-width:104rem;padding:1rem clamp(.8rem,3vw,2rem) 3rem;background:var(--paper);color:var(--ink);
font:1rem/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",sans-serif;overflow-wrap:anywhere}
h1{font-size:1.5rem;line-height:1.2;margin:.4rem 0 .2rem}h2{font-size:1.15rem;margin:2.4rem 0 .6rem;
border-top:1px solid var(--line);padding-top:1rem}h3{font-size:1rem;margin:1.2rem 0 .3rem}
main{display:grid;grid-template-columns:minmax(0,1fr);column-gap:2rem}section{grid-column:1/-1;min-width:0}
@media (min-width:70rem){main{grid-template-columns:repeat(2,minmax(0,1fr))}.half{grid-column:auto}
.beside{display:grid;grid-template-columns:repeat(2,minmax(0,1fr));column-gap:2rem;align-items:start}
.beside>*{grid-column:1}.beside>h2,.beside>.all{grid-column:1/-1}.beside>.table{grid-column:2;grid-row:2/span 9}
.beside>.rows{grid-column:2}}
p{margin:.4rem 0;max-width:44rem}.soft,figcaption,th{color:var(--soft)}a{color:var(--blue)}
nav{font-size:.9rem;margin:.6rem 0 1rem}nav a{margin-right:.9rem;display:inline-block;
padding:.15rem 0}
.cards{display:grid;grid-template-columns:repeat(auto-fit,minmax(11.6rem,1fr));gap:.7rem;margin:1rem 0}
.card{background:var(--card);border:1px solid var(--line);border-left:.35rem solid var(--soft);border-radius:.4rem;
padding:.6rem .8rem}.card b{display:block;font-size:1.25rem;line-height:1.25;margin:.1rem 0 .25rem}
.card p{font-size:.88rem;margin:0}.card small{color:var(--soft)}.good{border-left-color:var(--green)}
.look{border-left-style:double;border-left-color:var(--red)}.bad{border-left-color:var(--red)}
.card div{display:flex;justify-content:space-between;gap:.4rem}
.sign{font-size:.85rem;color:var(--soft);white-space:nowrap}.good .sign{color:var(--green)}
.look .sign,.bad .sign{color:var(--red);font-weight:600}
.pair{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(21rem,100%),1fr));gap:1rem 2rem}
.pair>*{min-width:0}
figure{margin:.8rem 0;max-width:34rem;break-inside:avoid}figcaption{font-size:.88rem;margin-top:.3rem}
.wide{max-width:none}svg{display:block;width:100%;height:auto}
svg text{font-size:11px;fill:var(--ink);unicode-bidi:isolate}svg .small{font-size:10px;fill:var(--soft)}
svg .tiny{font-size:8.5px;fill:var(--soft)}svg .strong{fill:var(--card);font-weight:600}
svg path{fill:none;stroke-width:1.4}.grid{stroke:var(--line)}svg .grid{stroke-width:.7}.tick{stroke:var(--blue)}
.retracted{stroke:var(--red);stroke-dasharray:2 2}.branch{stroke:var(--blue)}
.fill{fill:var(--blue)}.wrong{fill:var(--red)}
.none{fill:var(--band)}.point{fill:var(--blue)}.whisker{stroke:var(--blue)}
.ideal{stroke:var(--soft);stroke-dasharray:4 3}.own{stroke:var(--blue)}svg .own{stroke-width:2.2}
svg .thin{stroke-width:.8}
.rival{stroke:var(--red);stroke-dasharray:6 3}.other{stroke:var(--soft);stroke-opacity:.5}
.decided{stroke:var(--green);stroke-dasharray:2 2}
.table{overflow:auto;border:1px solid var(--line);border-radius:.4rem;margin:.6rem 0;
background:linear-gradient(90deg,var(--card) 40%,transparent) 0 0/2.5rem 100% no-repeat local,
linear-gradient(270deg,var(--card) 40%,transparent) 100% 0/2.5rem 100% no-repeat local,
linear-gradient(90deg,var(--shade),transparent) 0 0/.8rem 100% no-repeat,
linear-gradient(270deg,var(--shade),transparent) 100% 0/.8rem 100% no-repeat,var(--card)}
.long{max-height:44rem}.rows{font-size:.88rem;color:var(--soft);margin:.2rem 0 .8rem}
table{border-collapse:collapse;font-size:.88rem;width:100%}
th,td{padding:.28rem .6rem;text-align:left;border-bottom:1px solid var(--line);vertical-align:top}
th{position:sticky;top:0;background:var(--card);font-weight:600;white-space:nowrap}tr:last-child td{border-bottom:0}
td.number,th.number{text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}td.name{min-width:min(7rem,18vw)}
.pictures{display:grid;grid-template-columns:repeat(auto-fill,minmax(9.5rem,1fr));gap:.7rem}
.pictures figure{margin:0}.pictures img,.wide img{display:block;width:100%;border-radius:.25rem}
.pictures img{height:4.2rem}.frames img{height:auto}.wide img{image-rendering:pixelated}
.pictures figcaption{font-size:.8rem;line-height:1.3}
pre{overflow:auto;white-space:pre-wrap;max-height:20rem;border:1px solid var(--line);border-radius:.4rem;
background:var(--card);padding:.5rem .8rem;margin:.6rem 0;line-height:1.6}
code{font-family:ui-monospace,Menlo,Consolas,monospace;font-size:.85em}
footer{margin-top:2.5rem;border-top:1px solid var(--line);padding-top:.8rem;font-size:.85rem;color:var(--soft)}
@media print{:root{color-scheme:light;--paper:#fff;--ink:#000;--soft:#444;--line:#ccc;--card:#fff;--blue:#0067a8;
--red:#c04a00;--green:#00795a;--band:#eee}body{max-width:none;padding:0;font-size:10pt}nav{display:none}
.table,pre{max-height:none;overflow:visible}.rows{display:none}
table{font-size:8pt}th,td{padding:.1rem .35rem}th,th.number{position:static;white-space:normal}td.name{min-width:0}
h2,h3{break-after:avoid}tr,.card{break-inside:avoid}
figure{max-width:13cm}*{print-color-adjust:exact;-webkit-print-color-adjust:exact}}
"""


def page(title: str, under: str, summary: str, sections: Sequence[tuple[str, str, str]], foot: str) -> str:
    """The whole page. under: what stands below the title; sections: anchor, heading and HTML of each; all but names are
    HTML already."""
    links = "".join(f'<a href="#{anchor}">{shown(heading)}</a>' for anchor, heading, _ in sections)
    body = "".join(
        f'<section id="{anchor}"{KINDS.get(anchor, "")}><h2>{shown(heading)}</h2>{inside}</section>\n'
        for anchor, heading, inside in sections
    )
    policy = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f'<meta name="color-scheme" content="light dark"><link rel="icon" href="data:,">'
        f"<title>{shown(title)}</title><style>{STYLE}</style></head>\n<body><header><h1>{name_of(title)}</h1>"
        f'<p class="soft">{under}</p></header>{summary}<nav aria-label="sections">{links}</nav>\n'
        f"<main>{body}</main><footer>{foot}</footer></body></html>\n"
    )


def name_of(text: object) -> str:
    """A name, isolated from the text around it, in which direction it may be read."""
    return f"<bdi>{shown(text)}</bdi>"


def cards(found: Iterable[Card]) -> str:
    """What is to be seen first."""
    parts = []
    for state, heading, answer, more in found:
        sign, meaning = SIGNS[state]
        parts.append(
            f'<div class="card {state}"><div><small>{shown(heading)}</small><span class="sign">{sign} {meaning}</span>'
            f"</div><b>{name_of(answer)}</b><p>{shown(more)}</p></div>"
        )
    return f'<div class="cards">{"".join(parts)}</div>'


def figure(drawing: str, caption: str) -> str:
    """A drawing, and the sentence that says what it shows and how it is read."""
    return f"<figure>{drawing}<figcaption>{shown(caption)}</figcaption></figure>"


def side_by_side(*figures: str) -> str:
    """Figures beside each other where there is room."""
    return f'<div class="pair">{"".join(figures)}</div>'


def note(text: str) -> str:
    """A paragraph of plain text."""
    return f"<p>{shown(text)}</p>"


def lines(commands: Iterable[str]) -> str:
    """Commands to be copied, a line each."""
    listed = "\n".join(map(shown, commands))
    return f'<pre tabindex="0"><code>{listed}</code></pre>'


def table(header: Sequence[str], rows: Iterable[Sequence[object]], label: str) -> str:
    """A table; numbers are right-aligned, None is empty. A long one scrolls inside itself, and how long it is stands
    below. label: for screen readers."""
    found = [list(row) for row in rows]
    numeric = [bool(found) and all(row[i] is None or _is_number(row[i]) for row in found) for i in range(len(header))]
    kinds = [' class="number"' if number else ' class="name"' for number in numeric]
    heads = "".join(f"<th{kind}>{shown(name)}</th>" for kind, name in zip(kinds, header, strict=True))
    body = "".join(
        "<tr>" + "".join(f"<td{kind}>{_cell(cell)}</td>" for kind, cell in zip(kinds, row, strict=True)) + "</tr>"
        for row in found
    )
    long = len(found) > LONG
    head = f'<div class="table{" long" * long}" tabindex="0" role="region" aria-label="{shown(label)}"><table>'
    more = f'<p class="rows">{len(found)} rows: the table scrolls.</p>' if long else ""
    return f"{head}<thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table></div>{more}"


def _is_number(cell: object) -> bool:
    return isinstance(cell, int | float) or (isinstance(cell, str) and cell[:1] in "+−-0123456789" and len(cell) < 14)


def _cell(cell: object) -> str:
    if cell is None:
        return ""
    return brief(cell) if isinstance(cell, float) else str(cell) if isinstance(cell, int) else name_of(cell)


def require_page(path: str | os.PathLike[str]) -> Path:
    """The path of a page to write. Raises InputError where it does not end in .html: it might be something else's."""
    target = Path(path)
    if target.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"expected a page to write that ends in .html; came {target}")
    return target


def save(html: str, path: str | os.PathLike[str]) -> None:
    """Write a page, whole or not at all.

    Raises InputError for a path that does not end in .html or cannot be written.
    """
    target = require_page(path)
    try:
        with tempfile.TemporaryDirectory(dir=target.parent) as folder:
            draft = Path(folder) / target.name
            draft.write_text(html, encoding="utf-8")
            draft.replace(target)
    except OSError as error:
        raise InputError(f"{target} cannot be written: {error.strerror}") from error
