"""A vehicle without a field over a link that its field fills, with real client, server and link."""

from pathlib import Path
from typing import Any

import numpy as np

from cav_agent.config import PaceKind
from mec_server.fields.service import MESSAGE_BYTES
from rfcore.field import FieldStore, SplatField
from rfcore.field.store import encode_field
from rfcore.raster.gaussians import Gaussians
from rfedge.link import LinkSettings
from rfedge.link.proxy import LinkProxy

ARRAYS = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
CRF = 23.0


def many_splats(field: SplatField, times: int) -> SplatField:
    """The splats of a field many times over, moved a little: an archive of many chunks."""
    arrays = {n: np.repeat(getattr(field.gaussians, n), times, axis=0) for n in ARRAYS}
    means = arrays["means"]
    arrays["means"] = means + np.random.default_rng(5).normal(0, 0.1, means.shape)
    return SplatField(Gaussians(**{n: a.astype(np.float32) for n, a in arrays.items()}))


async def test_pictures_are_good_while_the_field_arrives(
    street: Any, serve: Any, vehicle: Any, tmp_path: Path
) -> None:
    """Answers wait for 1.6 s behind the field's window where that is sent without rests."""
    store = tmp_path / "fields"
    archive = encode_field(many_splats(street.field, 48).compressed())
    field_id = FieldStore(store).add(archive)
    assert len(archive) > 5 * MESSAGE_BYTES
    async with serve(fields=store) as server:
        link = LinkProxy(
            LinkSettings(str(server.address), uplink_bps=1e6, downlink_bps=4e5, delay_ms=5.0)
        )
        await link.start()
        changes = {"fields": tmp_path / "mine", "loop": True, "pace": PaceKind.REALTIME}
        async with vehicle(link.address, **changes, crf=CRF, max_delay_ms=1500.0) as driving:
            await driving.until((tmp_path / "mine" / f"{field_id}.rff").exists)
        await link.stop()
    coded = [line["crf"] for line in driving.lines() if line["result"] == "acked"]
    assert len(coded) >= 10
    assert np.mean(np.array(coded) <= CRF) >= 0.9
