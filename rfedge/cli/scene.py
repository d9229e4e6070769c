"""``rfedge scene``: datasets made from what users own, one module a verb."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import subcommand

from rfedge.cli.scene_build import SceneBuild
from rfedge.cli.scene_convert import SceneConvert
from rfedge.cli.scene_plan import ScenePlan
from rfedge.cli.scene_poses import ScenePoses
from rfedge.cli.scene_record_carla import SceneRecordCarla
from rfedge.cli.scene_sheet import SceneSheet
from rfedge.cli.scene_sizes import SceneSizes

__all__ = ["Scene"]


@dataclass(frozen=True)
class Scene:
    """Make datasets: render a street, convert recordings, find poses, record a simulator."""

    verb: (
        Annotated[SceneBuild, subcommand("build")]
        | Annotated[SceneConvert, subcommand("convert")]
        | Annotated[ScenePoses, subcommand("poses")]
        | Annotated[ScenePlan, subcommand("plan")]
        | Annotated[SceneSheet, subcommand("sheet")]
        | Annotated[SceneSizes, subcommand("sizes")]
        | Annotated[SceneRecordCarla, subcommand("record-carla")]
    )

    def run(self) -> None:
        """Run the verb."""
        self.verb.run()
