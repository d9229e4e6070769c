"""Bit-exact kernels of rfcore; use the wrappers in rfcore.native."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

# --- raster -----------------------------------------------------------------

_F32 = NDArray[np.float32]

def available_isas() -> list[str]: ...

class RasterCamera:
    def __init__(self, numbers: Sequence[float], width: int, height: int) -> None: ...

class Rasterizer:
    def __init__(
        self,
        means: _F32,
        quaternions: _F32,
        log_scales: _F32,
        opacity_logits: _F32,
        sh: _F32,
        threads: int,
        isa: str,
        antialiased: bool,
    ) -> None: ...
    @property
    def isa(self) -> str: ...
    def with_threads(self, threads: int) -> Rasterizer: ...
    def render(
        self, camera: RasterCamera, degree: int, colour: _F32, depth: _F32, opacity: _F32
    ) -> None: ...
    def render_colour(self, camera: RasterCamera, degree: int, colour: _F32) -> None: ...
    def statistics(self, camera: RasterCamera) -> tuple[int, int, int, int, int]: ...

class TrainableRasterizer:
    def __init__(
        self,
        means: _F32,
        quaternions: _F32,
        log_scales: _F32,
        opacity_logits: _F32,
        sh: _F32,
        threads: int,
        isa: str,
        antialiased: bool,
    ) -> None: ...
    def forward(
        self, camera: RasterCamera, degree: int, colour: _F32, depth: _F32, opacity: _F32
    ) -> None: ...
    def forward_colour(self, camera: RasterCamera, degree: int, colour: _F32) -> None: ...
    def loss(self, colour: _F32, target: _F32, dssim_weight: float) -> float: ...
    def exposed_loss(
        self,
        colour: _F32,
        target: _F32,
        dssim_weight: float,
        affine: _F32,
        d_affine: NDArray[np.float64],
    ) -> float: ...
    def set_colour_gradient(self, d_colour: _F32) -> None: ...
    def backward(self, colour: _F32) -> None: ...
    def adam_step(self, rates: Sequence[float]) -> None: ...
    def gradients(
        self, means: _F32, quaternions: _F32, log_scales: _F32, opacity_logits: _F32, sh: _F32
    ) -> None: ...
    def parameters(
        self, means: _F32, quaternions: _F32, log_scales: _F32, opacity_logits: _F32, sh: _F32
    ) -> None: ...
    @property
    def count(self) -> int: ...
    def keep_scores(self, keep: bool) -> None: ...
    def control_density(
        self, dead_logit: float, added: int, by_gradient: bool, in_place: bool, seed: int
    ) -> int: ...
    def perturb(self, strength: float, seed: int) -> None: ...
    def remove_dead(self, dead_logit: float) -> None: ...
    def order_along_curve(self) -> None: ...
    def moments(
        self, first: Sequence[_F32], second: Sequence[_F32], beta_powers: NDArray[np.float64]
    ) -> None: ...
    def set_moments(
        self, first: Sequence[_F32], second: Sequence[_F32], beta_powers: Sequence[float]
    ) -> None: ...
    def scores(self, out: _F32) -> None: ...
    def set_scores(self, scores: _F32) -> None: ...

# --- ngp --------------------------------------------------------------------

_U32 = NDArray[np.uint32]
_I32 = NDArray[np.int32]

class NgpCamera:
    def __init__(self, numbers: Sequence[float], width: int, height: int) -> None: ...

def ngp_table_entries(level_cells: _I32, hashed_entries: int) -> int: ...

class NgpRenderer:
    def __init__(
        self,
        box: Sequence[float],
        grid: Sequence[int],
        level_cells: _I32,
        occupancy: _U32,
        edges: _F32,
        table: _F32,
        matrices: _F32,
        threads: int,
        isa: str,
    ) -> None: ...
    @property
    def isa(self) -> str: ...
    def render(
        self, camera: NgpCamera, samples_per_ray: int, colour: _F32, depth: _F32, opacity: _F32
    ) -> int: ...
    def render_colour(self, camera: NgpCamera, samples_per_ray: int, colour: _F32) -> int: ...

class NgpTrainer:
    def __init__(
        self,
        box: Sequence[float],
        grid: Sequence[int],
        level_cells: _I32,
        occupancy: _U32,
        edges: _F32,
        table: _F32,
        matrices: _F32,
        peaks: _F32,
        threads: int,
        isa: str,
    ) -> None: ...
    def accumulate(
        self,
        origins: _F32,
        directions: _F32,
        jitter: _F32,
        targets: _F32,
        rays_per_block: int,
        samples_per_ray: int,
    ) -> float: ...
    def update(self, rates: Sequence[float], peak_decay: float) -> None: ...
    def gradients(self, table: _F32, matrices: _F32) -> None: ...
    def rebuild_occupancy(self, threshold: float) -> int: ...
    @property
    def samples(self) -> int: ...
    @property
    def steps(self) -> int: ...
    def set_steps(self, steps: int) -> None: ...
    def read(self, which: int, out: _F32) -> None: ...
    def write(self, which: int, values: _F32) -> None: ...
    def read_occupancy(self, out: _U32) -> None: ...
    def write_occupancy(self, words: _U32) -> None: ...

# --- warp -------------------------------------------------------------------

_U8 = NDArray[np.uint8]

def warp_filter() -> bytes: ...
def block_costs(frame: _U8, reference: _U8, satd: _I32, ssd: _I32) -> None: ...
def solve_light(
    frame: tuple[_U8, _U8, _U8], render: tuple[_U8, _U8, _U8], changes: _I32
) -> None: ...
def apply_light(changes: _I32, render: tuple[_U8, _U8, _U8], y: _U8, u: _U8, v: _U8) -> None: ...
def relight_i420(
    seen: tuple[_U8, _U8, _U8],
    seen_render: tuple[_U8, _U8, _U8],
    render: tuple[_U8, _U8, _U8],
    y: _U8,
    u: _U8,
    v: _U8,
) -> None: ...
def warp_i420(
    previous: tuple[_U8, _U8, _U8],
    previous_depth: _F32,
    depth: _F32,
    render: tuple[_U8, _U8, _U8],
    previous_render: tuple[_U8, _U8, _U8] | None,
    doubt: int,
    numbers: Sequence[float],
    y: _U8,
    u: _U8,
    v: _U8,
    threads: int,
) -> int: ...

# --- live_view --------------------------------------------------------------

def live_difference(
    picture: _U8,
    colour: _F32,
    opacity: _F32,
    light: Sequence[float],
    limits: Sequence[float],
    difference: _F32,
    share: _F32,
) -> None: ...
def carry_to_view(
    colour: _F32,
    opacity: _F32,
    depth: _F32,
    camera: Sequence[float],
    sources: Sequence[tuple[_F32, _F32, Sequence[float]]],
    limits: Sequence[float],
    rgb: _U8,
    chosen: _U8,
) -> None: ...
def draw_patch(
    samples: _F32,
    numbers: Sequence[float],
    source: int,
    limits: Sequence[float],
    box: Sequence[int],
    camera: Sequence[float],
    rgb: _U8,
    depth: _F32,
    chosen: _U8,
    nearest: _F32,
) -> None: ...

# --- h264 -------------------------------------------------------------------

class SliceEffort:
    def __init__(
        self,
        *,
        search_steps: int,
        subsample_steps: int,
        references_reach: int,
        intra_reach: int,
        halves_reach: int,
        shapes_reach: int,
        whole_trials: int,
        cost_rounds: int,
    ) -> None: ...

class SliceCoder:
    def __init__(self, width: int, height: int, isa: str, threads: int = 1) -> None: ...
    def encode(
        self,
        frame: tuple[_U8, _U8, _U8],
        references: Sequence[tuple[_U8, _U8, _U8]],
        slice_qp: int,
        qp: NDArray[np.int8],
        forced: NDArray[np.int8],
        lambda_q8: NDArray[np.uint32],
        motion_q8: NDArray[np.uint32],
        effort: SliceEffort,
        deblocked: bool,
        vertical_reach: int,
        out: tuple[_U8, _U8, _U8],
        modes: NDArray[np.int8],
    ) -> bytes: ...

# --- pcm --------------------------------------------------------------------

def pcm_macroblocks(y: _U8, u: _U8, v: _U8, out: _U8) -> None: ...

# --- yuv --------------------------------------------------------------------

def i420_from_colour(
    colour: NDArray[np.float32], y: NDArray[np.uint8], u: NDArray[np.uint8], v: NDArray[np.uint8]
) -> int: ...
def i420_from_rgb(
    rgb: NDArray[np.uint8], y: NDArray[np.uint8], u: NDArray[np.uint8], v: NDArray[np.uint8]
) -> None: ...
def rgb_from_i420(
    y: NDArray[np.uint8], u: NDArray[np.uint8], v: NDArray[np.uint8], rgb: NDArray[np.uint8]
) -> None: ...
