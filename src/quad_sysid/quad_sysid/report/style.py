"""What every page shares: shell, scripts, and a style sheet: colours, sizes, tables, print."""

from __future__ import annotations

from html import escape
from pathlib import Path

LIGHT = """--paper:#ffffff;--card:#f6f8fa;--line:#d5dae0;--ink:#1b1f24;
--muted:#5f6b78;--grid:#d5dae0;--blue:#0072b2;--orange:#d55e00;--green:#009e73;--sky:#56b4e9;--pink:#cc79a7;"""
DARK = """--paper:#12161b;--card:#1a2027;--line:#333c46;--ink:#e8ecf0;
--muted:#9aa7b4;--grid:#2b333c;--blue:#56b4e9;--orange:#f08a3c;--green:#2fbf95;--sky:#9bd4f5;--pink:#e0a3c4;"""

SHEET = (
    ':root{color-scheme:light dark;--font:system-ui,-apple-system,"Segoe UI",Roboto,'
    '"DejaVu Sans",sans-serif;' + LIGHT + '}'
    '@media (prefers-color-scheme:dark){:root{' + DARK + '}}'
    """
*{box-sizing:border-box}
body{margin:0 auto;max-width:1120px;padding:16px;background:var(--paper);color:var(--ink);
font:16px/1.5 var(--font)}
h1,h2,p,li{overflow-wrap:anywhere}
h1{font-size:1.5rem;margin:.2em 0}h2{font-size:1.3rem;margin:1.8em 0 .4em;
border-top:1px solid var(--line);padding-top:.8em}h3{font-size:1.08rem;margin:1.4em 0 .4em}
h4{font-size:.95rem;margin:0 0 .3em}p{margin:.4em 0}
a{color:var(--blue)}nav{margin:.6em 0}nav a{margin-right:1em}
.small,figcaption{color:var(--muted);font-size:.85rem}
.answer{background:var(--card);border:1px solid var(--line);border-left:6px solid var(--muted);
border-radius:8px;padding:12px 16px;margin:14px 0}
.answer.found{border-left-color:var(--blue)}.answer.good{border-left-color:var(--green)}
.answer.open{border-left-color:var(--orange)}
.answer h2{border:0;margin:0 0 .3em;padding:0}.axis{display:inline-block;text-transform:capitalize}
.answer h3{font-size:.95rem;margin:.8em 0 0}
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(130px,1fr));gap:8px;margin:10px 0}
.tile{background:var(--paper);border:1px solid var(--line);border-radius:6px;padding:6px 10px}
.tile b{display:block;font-size:1.08rem}.tile span{color:var(--muted);font-size:.8rem}
.figures{columns:2 400px;column-gap:16px;margin-top:.8em}
figure{margin:0 0 16px;break-inside:avoid;padding:10px;
border:1px solid var(--line);border-radius:8px;min-width:0}
figure svg{display:block;width:100%;height:auto}figure svg text{fill:var(--ink)}
.scroll{overflow-x:auto;margin:.6em 0;
background:linear-gradient(90deg,var(--paper) 30%,transparent),
linear-gradient(270deg,var(--paper) 30%,transparent) 100% 0,
linear-gradient(90deg,var(--muted),transparent),
linear-gradient(270deg,var(--muted),transparent) 100% 0;background-repeat:no-repeat;
background-size:40px 100%,40px 100%,10px 100%,10px 100%;
background-attachment:local,local,scroll,scroll}
.copy{position:relative}.copy pre{background:var(--card);border:1px solid var(--line);
border-radius:6px;padding:8px 12px;overflow-x:auto;font-size:.85rem}
.copy button{position:absolute;top:6px;right:6px;font:inherit;font-size:.8rem;padding:2px 10px;
border:1px solid var(--line);border-radius:6px;background:var(--paper);color:var(--ink);
cursor:pointer}
table{border-collapse:collapse;font-size:.88rem}
th,td{text-align:left;padding:4px 10px 4px 0;border-bottom:1px solid var(--line);
vertical-align:top}
th{font-weight:600;color:var(--muted);white-space:nowrap}
.n{text-align:right;white-space:nowrap;font-variant-numeric:tabular-nums}
td:first-child{min-width:7em}td.w{min-width:17em}tr.sel td:first-child{font-weight:700}
tr.sel td{background:var(--card)}details{margin:.6em 0}summary{cursor:pointer}
@media (max-width:520px){body{padding:10px}figure{padding:6px}.answer{padding:10px}}
@media print{:root{"""
    + LIGHT
    + """}body{max-width:none;font-size:11pt;padding:0;-webkit-print-color-adjust:exact;
print-color-adjust:exact}nav,button{display:none}figure,.answer,tr,pre{break-inside:avoid}h2,h3,h4{break-after:avoid}
.figures{columns:2}.scroll{overflow:visible;background:none}table{font-size:8.5pt}}
"""
)


def script(name: str) -> str:
    """The element with a script of this folder, to stand behind the last that it draws."""
    text = Path(__file__).with_name(name).read_text(encoding='utf-8')
    return f'<script>{text}</script>'


def document(title: str, *body: str, mark: str = '', style: str = '') -> str:
    """A whole page; `mark` is the element by which the command that made it knows it again."""
    return '\n'.join([
        f'<!doctype html><html lang="en"><head><meta charset="utf-8">{mark}',
        '<meta name="viewport" content="width=device-width,initial-scale=1">',
        f'<title>{escape(title)}</title><style>{SHEET}{style}</style></head><body>',
        *body, '</body></html>\n'])
