"""``rfedge field``: fields as files. One module a sub-verb."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import subcommand

from rfedge.cli.field_check import FieldCheck
from rfedge.cli.field_export import FieldExport
from rfedge.cli.field_import import FieldImport
from rfedge.cli.field_info import FieldInfo
from rfedge.cli.field_list import FieldList
from rfedge.cli.field_publish import FieldPublish
from rfedge.cli.field_rollback import FieldRollback
from rfedge.cli.field_rungs import FieldRungs
from rfedge.cli.field_slim import FieldSlim

__all__ = ["Field"]

SubVerb = (
    Annotated[FieldImport, subcommand("import")]
    | Annotated[FieldInfo, subcommand("info")]
    | Annotated[FieldCheck, subcommand("check")]
    | Annotated[FieldSlim, subcommand("slim")]
    | Annotated[FieldRungs, subcommand("rungs")]
    | Annotated[FieldExport, subcommand("export")]
    | Annotated[FieldPublish, subcommand("publish")]
    | Annotated[FieldList, subcommand("list")]
    | Annotated[FieldRollback, subcommand("rollback")]
)


@dataclass(frozen=True)
class Field:
    """Import, inspect, check, slim, refine, export and publish radiance fields."""

    verb: SubVerb

    def run(self) -> None:
        """Run the sub-verb."""
        self.verb.run()
