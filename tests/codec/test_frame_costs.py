"""D + lambda R of blocks: its formula in plain Python, and that nothing is computed twice."""

import numpy as np
import pytest

from codec.pictures import flat, noise, pair
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.references import Reference
from rfcore.codec.sender import rate
from rfcore.codec.sender.encoder import DeltaEncoder, FrameChoice
from rfcore.codec.sender.rate import FrameCosts, RateDistortion, RateModel, RateTarget
from rfcore.image import I420
from rfcore.native.warp import BlockCosts

SIZE_PX = (96, 64)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """The pairs of luma planes that the kernel was asked about, by identity."""
    made: list[tuple[int, int]] = []
    kept = []  # so that no plane's id is given to another one
    kernel = rate.block_costs

    def noted(frame: np.ndarray, picture: np.ndarray) -> BlockCosts:
        made.append((id(frame), id(picture)))
        kept.append((frame, picture))
        return kernel(frame, picture)

    monkeypatch.setattr(rate, "block_costs", noted)
    return made


def cost_of_block(satd: int, ssd: int, crf: float) -> float:
    step, bit_price = 2 ** ((crf - 4) / 6), 0.57 * 2 ** ((crf - 12) / 3)
    coded = min(ssd, step**2 * 64 / 12) + bit_price * (1 + max(0.0, satd / step - 16))
    return min(float(ssd), coded)


@pytest.mark.parametrize("crf", [1.0, 23.0, 35.5, 51.0])
def test_each_block_costs_what_the_formula_says(crf):
    frame, view = pair(*SIZE_PX)
    blocks = FrameCosts(frame).against(view.render)
    got = RateDistortion.at(crf).coded_or_copied(blocks)
    for row, column in np.ndindex(got.shape):
        satd, ssd = int(blocks.satd[row, column]), int(blocks.ssd[row, column])
        assert got[row, column] == pytest.approx(cost_of_block(satd, ssd, crf))


def test_a_frame_against_itself_costs_nothing():
    frame = noise(*SIZE_PX, 1)
    assert RateDistortion.at(23).coded_or_copied(FrameCosts(frame).against(frame)).max() == 0


def test_a_dearer_bit_and_a_coarser_step_never_make_a_frame_cheaper():
    frame, view = pair(*SIZE_PX)
    blocks = FrameCosts(frame).against(view.render)
    totals = [float(RateDistortion.at(crf).coded_or_copied(blocks).sum()) for crf in range(1, 52)]
    assert totals == sorted(totals)
    assert totals[-1] <= blocks.ssd.sum(), "what is copied costs its error"


def test_blocks_of_one_level_cost_nothing_without_a_reference():
    levels = np.random.default_rng(1).integers(1, 255, (8, 12), dtype=np.uint8)
    luma = levels.repeat(8, 0).repeat(8, 1)
    frame = I420(luma, *flat(*SIZE_PX, 128).planes[1:])
    assert FrameCosts(frame).intra.ssd.max() == 0
    assert FrameCosts(frame).intra.satd.max() == 0


def test_many_short_lived_pictures_are_never_mistaken_for_one_another():
    """Memory that was freed may be used again, and so may the identity of a picture."""
    frame = pair(*SIZE_PX)[0]
    costs = FrameCosts(frame)
    for level in range(1, 60):
        picture = I420(np.full_like(frame.y, level), frame.u, frame.v)
        expected = (frame.y.astype(int) - level) ** 2
        assert costs.against(picture).ssd.sum() == expected.sum()


def test_coding_a_frame_under_rate_control_computes_no_picture_twice(calls):
    encoder = DeltaEncoder(CodecConfig(*SIZE_PX, effort="fast"))
    state, model = encoder.start(1), RateModel()
    for index in range(3):
        frame, view = pair(*SIZE_PX, 2.0 * index)
        costs = FrameCosts(frame)
        choice = FrameChoice(crf=18.0, target=RateTarget(600, model))
        made = encoder.encode(state, frame, view, choice, costs)
        state, model = made.state, made.rate or model
    assert Reference.PREVIOUS in made.packet.references, "an earlier frame took part"
    assert len(set(calls)) == len(calls)
