"""The report as one HTML page that needs nothing beside it: styles and pictures are inside."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined

from sprung.model.diagnosis.report.report import Report
from sprung.service.report import words
from sprung.service.report.values import rows

STYLE = """
:root{--ink:#22303c;--quiet:#6b7885;--line:#e1e6eb;--bad:#c1121f;--good:#0b7a75}
*{box-sizing:border-box}body{margin:0;background:#f4f6f8;color:var(--ink);
font:15px/1.5 "Segoe UI",Roboto,"Helvetica Neue",Arial,"Liberation Sans","DejaVu Sans",sans-serif}
main{max-width:1120px;margin:0 auto;padding:28px 20px 60px}
header{margin-bottom:18px}h1{font-size:25px;line-height:1.25;margin:6px 0 4px}h2{font-size:17px;margin:0 0 10px}
.lead{font-size:17px;margin:8px 0 0}.meta{color:var(--quiet);font-size:13px}
.tag{display:inline-block;border-radius:4px;padding:2px 10px;font-size:13px;font-weight:600;color:#fff}
.consistent{background:var(--good)}.missing_physics,.unknown_physics{background:var(--bad)}
.sensor_fault{background:#b45309}
section{background:#fff;border:1px solid var(--line);border-radius:8px;padding:18px 20px;margin-top:16px}
.two{display:grid;grid-template-columns:repeat(auto-fit,minmax(420px,1fr));gap:16px}
.two section{margin-top:0}.two{margin-top:16px}
img{max-width:100%;height:auto;display:block;margin:0 auto}
.figures{display:flex;gap:34px;flex-wrap:wrap}.figures b{font-size:24px;display:block;line-height:1.2}
.figures span{color:var(--quiet);font-size:13px}
table{border-collapse:collapse;width:100%;font-size:13.5px}th{font-weight:600;color:var(--quiet);text-align:left}
th,td{padding:4px 10px 4px 0;border-bottom:1px solid var(--line);white-space:nowrap}
td.n,th.n{text-align:right;font-variant-numeric:tabular-nums}tr.on td{color:var(--bad);font-weight:600}
.scroll{overflow-x:auto}.note{color:var(--quiet);font-size:13px;margin:8px 0 0}
@media print{body{background:#fff}section{break-inside:avoid}}
"""

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width,initial-scale=1">
<title>{{ title }}</title><style>{{ style }}</style></head><body><main>
<header><span class="tag {{ report.verdict }}">{{ report.verdict.replace('_', ' ') }}</span>
<h1>{{ title }}</h1>
<p class="lead">{{ headline }}</p>
<p class="meta">{{ report.recording.file }}, {{ '%.1f' % report.recording.seconds }} s,
{{ report.recording.samples }} samples{% if report.recording.lost %}, {{ report.recording.lost }} lost{% endif %};
system {{ report.system }}</p></header>

<section><div class="figures">
<div><b>{{ '%.4f' % report.baseline_validation.nrmse }}</b><span>nrmse, nominal structure re-identified</span></div>
{% if report.findings %}<div><b>{{ '%.4f' % report.augmented_validation.nrmse }}</b>
<span>nrmse with what was found</span></div>{% endif %}
<div><b>{{ '%.4f' % report.noise_floor.nrmse }}</b><span>noise floor</span></div>
{% if report.explained is not none %}<div><b>{{ '%.1f' % (100 * report.explained) }} %</b>
<span>of the excess error explained</span></div>{% endif %}
</div><p class="note">Free-running simulation of the last part of the recording, which no fit has seen.
nrmse is rms(error) / rms(measured), pooled over the sensors.</p></section>

{% if 'system' in pictures %}<section><h2>Where</h2><img alt="the system with what was located"
 src="{{ pictures.system }}"></section>{% endif %}

{% if report.findings %}<section><h2>What was left out</h2><div class="scroll"><table>
<tr><th>place</th><th>effect</th><th>parameters</th><th class="n">p-value</th><th class="n">ΔBIC</th>
<th>runner-up</th><th class="n">its ΔBIC</th></tr>
{% for f in report.findings %}<tr><td><b>{{ f.location }}</b></td>
<td>{{ effect(f.effect) }}{% if f.family %} ({{ f.family }}){% endif %}</td>
<td>{% for p in f.parameters %}{{ p.name }} {{ quantity(p) }}{{ ', ' if not loop.last }}{% endfor %}</td>
<td class="n">{{ probability(f.p_value) if f.p_value is not none else '-' }}</td>
<td class="n">{{ '%.0f' % f.delta_bic if f.delta_bic is not none else '-' }}</td>
{% if f.runner_up %}<td>{{ effect(f.runner_up[0]) }}{% if f.runner_up_location %} at {{ f.runner_up_location }}
{% endif %}</td><td class="n">{{ '%.0f' % f.runner_up[1] }}</td>{% else %}<td>-</td><td></td>{% endif %}</tr>
{% endfor %}</table></div>
{% for f in report.findings if f.advice %}<p class="note">{{ f.location }}: {{ f.advice }}</p>{% endfor %}
</section>{% endif %}

{% for group in groups %}<section><h2>{{ group.title }}</h2>
{% for picture in group.pictures %}<img alt="{{ group.title }}" src="{{ picture }}">{% endfor %}
{% if group.note %}<p class="note">{{ group.note }}</p>{% endif %}</section>{% endfor %}

{% if 'sensors' in pictures or 'locations' in pictures %}<div class="two">
{% for key, name in (('sensors', 'Fit of every sensor'), ('locations', 'Evidence by place')) if key in pictures %}
<section><h2>{{ name }}</h2><img alt="{{ name }}" src="{{ pictures[key] }}"></section>{% endfor %}</div>{% endif %}

{% if rows %}<section><h2>Parameters, bars of two standard deviations</h2>
{% if 'parameters' in pictures %}<img alt="parameters before and after" src="{{ pictures.parameters }}">{% endif %}
<div class="scroll"><table><tr><th>parameter</th><th>unit</th><th class="n">nominal</th>
<th class="n">nominal structure</th><th class="n">± std</th>{% if report.findings %}<th class="n">with finding</th>
<th class="n">± std</th><th class="n">bias it had</th>{% endif %}</tr>
{% for r in rows %}<tr{% if r.significant and r.bias|abs > 0.02 %} class="on"{% endif %}><td>{{ r.name }}</td>
<td>{{ r.unit }}</td><td class="n">{{ number(r.nominal) }}</td><td class="n">{{ number(r.before) }}</td>
<td class="n">{{ number(r.before_std, 2) }}</td>{% if report.findings %}<td class="n">{{ number(r.after) }}</td>
<td class="n">{{ number(r.after_std, 2) }}</td>
<td class="n">{% if r.bias is not none %}{{ '%+.1f' % (100 * r.bias) }} %{% else %}-{% endif %}</td>{% endif %}</tr>
{% endfor %}</table></div>
{% for change in report.changes %}<p class="note">{{ change }}</p>{% endfor %}</section>{% endif %}

{% if report.candidates %}<section><h2>Everything that was weighed</h2><div class="scroll"><table>
<tr><th>place</th><th>effect</th><th class="n">score</th><th class="n">p-value</th><th class="n">ΔBIC</th></tr>
{% for c in report.candidates %}<tr{% if (c.location, c.effect) in named %} class="on"{% endif %}>
<td>{{ c.location }}</td><td>{{ effect(c.effect) }}</td><td class="n">{{ '%.1f' % c.score }}</td>
<td class="n">{{ probability(c.p_value) }}</td>
<td class="n">{% if c.delta_bic is not none %}{{ '%.0f' % c.delta_bic }}{% else %}-{% endif %}</td></tr>
{% endfor %}</table></div><p class="note">Score: chi-square of the screening with the nominal parameters' own
sensitivities projected out. p-values account for all places and laws tried. ΔBIC: against the nominal structure,
after a full fit; negative is better.</p></section>{% endif %}

{% if report.advice %}<section><h2>What this recording cannot decide</h2><ul>
{% for line in report.advice %}<li>{{ line }}</li>{% endfor %}</ul></section>{% endif %}
</main></body></html>
"""


def inline(path: Path) -> str:
    """A PNG as a data address."""
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode("ascii")


def render(report: Report, pictures: Mapping[str, Path]) -> str:
    """The page; pictures are keyed as `service.report.draw_pictures` names them."""
    inside = {key: inline(path) for key, path in pictures.items()}
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=False)
    return environment.from_string(PAGE).render(
        report=report,
        title=words.VERDICTS[report.verdict],
        headline=words.headline(report),
        style=STYLE,
        pictures=inside,
        groups=_groups(report, inside),
        rows=rows(report),
        named={(f.location, f.effect) for f in report.findings},
        effect=words.effect_words,
        quantity=words.quantity,
        probability=words.probability,
        number=words.number,
    )


def _groups(report: Report, inside: Mapping[str, str]) -> list[dict[str, Any]]:
    """The pictures of each finding, then the fit in time and frequency."""
    groups = []
    for number, finding in enumerate(report.findings):
        own = [inside[key] for key in (f"force_{number}", f"residual_{number}") if key in inside]
        if own:
            title = f"{finding.location}: {words.finding_words(finding)}"
            groups.append({"title": title, "pictures": own, "note": ""})
    if "fit" in inside:
        groups.append(
            {
                "title": "Measured against simulated, held-out part",
                "pictures": [inside["fit"]],
                "note": "Free-running: the simulation sees the measured inputs only.",
            }
        )
    return groups
