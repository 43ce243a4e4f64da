# SPDX-License-Identifier: Apache-2.0
"""Common parts of the reports: templates, inlined figures, numbers."""

from __future__ import annotations

import base64
import gzip
import importlib.resources
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup

from remaster_ros.calibration.predictions import Coverage
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.effects.unnamed import EFFECT as NO_NAME
from remaster_ros.discovery.explain import FoundEffect, LookAlike
from remaster_ros.discovery.words import p_value_text, percent, probability_text, shown
from remaster_ros.reports.figure_style import GRID, INK, PAPER
from remaster_ros.reports.fit_json import REPORT_FILE
from remaster_ros.reports.schemas import MeasuredSession
from remaster_ros.reports.sentences import (
    METRICS,
    NO_TIMES,
    NOT_PROVEN,
    counts_words,
    coverage_words,
    look_alike_name,
    not_counted,
    size_words,
)
from remaster_ros.session.files import make_folder, write_atomically


def law(effect: FoundEffect) -> str:
    """Equation and source of an effect as text; '' if it is of no known name.

    For an effect without a name that happened at one moment, those of a step.
    """
    happened = effect.name == NO_NAME.name and effect.moment_s is not None
    kind = EFFECTS.get('step' if happened else effect.name)
    return '' if kind is None else f'{kind.equation} ({kind.source})'


def page(template: str, **content: Any) -> str:
    """Render a template of this package to the text of a page; all content is escaped.

    ``template``: its file name; ``content``: its variables. Raises jinja2.UndefinedError if
    one is missing.
    """
    environment = Environment(
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=FunctionLoader(_template),
    )
    environment.globals |= {'no_times': NO_TIMES, 'not_proven': NOT_PROVEN}
    environment.filters |= {
        'fixed': _fixed,
        'signed': _signed,
        'percent': percent,
        'probability': probability_text,
        'p_value': p_value_text,
        'shown': shown,
        'heading': lambda words: words[:1].upper() + words[1:],
        'metric': METRICS.__getitem__,
        'not_counted': not_counted,
        'counts': lambda session: counts_words(msgspec.convert(session, MeasuredSession)),
        'coverage': lambda found: coverage_words(
            msgspec.convert(found['predicted_regions95']['held_out'], Coverage),
            found['gain']['held_out_gross'],
        ),
        'summarized': summarized,
        'size': lambda effect: size_words(msgspec.convert(effect, FoundEffect)),
        'look_alike': lambda other, of: look_alike_name(
            msgspec.convert(of, FoundEffect), msgspec.convert(other, LookAlike)
        ),
        'law': lambda effect: law(msgspec.convert(effect, FoundEffect)),
    }
    return environment.get_template(template).render(**content)


def summarized(effect: Mapping[str, Any]) -> Markup:
    """Return a cause's sentence with its size in brackets, as HTML.

    ``effect``: as discovery.json has it.
    """
    size = size_words(msgspec.convert(effect, FoundEffect))
    return Markup('{} <span class="soft">({})</span>').format(effect['cause'], size)


def _template(name: str) -> str:
    """Text of a template of this package, by its file name."""
    return importlib.resources.files(__package__).joinpath(name).read_text(encoding='utf-8')


def inlined(name: str, svg: str) -> Markup:
    """Return an SVG figure for insertion into a page: with the page's colours, font and width.

    ``name``: prefix that makes its identifiers unique; ``svg``: its text.
    """
    svg = svg[svg.index('<svg') :]
    for color, ours in ((INK, 'var(--ink)'), (GRID, 'var(--line)'), (PAPER, 'none')):
        svg = svg.replace(color, ours)
    svg = re.sub(r"'DejaVu Sans'(, [^;\"]*)?", 'var(--font)', svg)
    for size in ('width', 'height'):
        svg = re.sub(rf'(<svg [^>]*?) {size}="[^"]*"', r'\1', svg, count=1)
    svg = re.sub(r'\bid="([^"]+)"', rf'id="{name}-\1"', svg)
    return Markup(re.sub(r'(url\(#|href="#)', rf'\1{name}-', svg))


def compressed(text: str) -> str:
    """Return a text gzip-compressed and in base64, for pages to unpack; always the same."""
    # The highest level takes twice as long, for a hundredth less.
    return base64.b64encode(gzip.compress(text.encode(), 5, mtime=0)).decode()


def write_report(folder: Path, drawings: dict[str, str], html: str) -> Path:
    """Write report.html, and the figures as SVG files in ``figures``; return the page's path.

    ``drawings``: SVG text by name. Raises DiskError if the folder cannot be written to.
    """
    make_folder(folder / 'figures')
    for name, text in drawings.items():
        write_atomically(folder / 'figures' / f'{name}.svg', text)
    write_atomically(folder / REPORT_FILE, html)
    return folder / REPORT_FILE


def _fixed(number: float | None, digits: int) -> str:
    """Number with a number of decimals and a typographic minus sign; a dash for None."""
    return '–' if number is None else _minus(f'{number:.{digits}f}')


def _signed(number: float, digits: int) -> str:
    """Number with its sign and a number of decimals; zero has none."""
    return _minus(f'{number:+.{digits}f}')


def _minus(text: str) -> str:
    """Number with typographic minus signs, and no sign for zero; ValueError if it is no number."""
    return text.removeprefix('-') if float(text) == 0.0 else text.replace('-', '−')
