"""Every page of the house: a template of this folder in the house's style."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from reports import numbers

TEMPLATES = Path(__file__).parent


def page_of(template: str, **content: Any) -> str:
    """A page of the house's style from one of the templates."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {"short": numbers.short, "known": numbers.known, "with_unit": numbers.with_unit}
    style = Markup((TEMPLATES / "report.css").read_text(encoding="utf-8"))
    return environment.get_template(template).render(style=style, **content)
