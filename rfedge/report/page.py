"""Pages of one run, as single HTML files in one style (``page.html.j2``)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from rfcore.files import write_whole


def write_page(
    path: Path, template: str, headline: str, made: Mapping[str, Any], **content: Any
) -> None:
    """Fill a template of this package and write it, with its folder.

    ``made`` is shown as JSON: how the run can be repeated. The template reads ``content``.
    """
    environment = Environment(
        loader=PackageLoader("rfedge", "."), autoescape=True, undefined=StrictUndefined
    )
    page = environment.get_template(template).render(
        headline=headline, made=json.dumps(made, indent=2, default=str), **content
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, page)
