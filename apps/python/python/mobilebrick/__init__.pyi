"""The interface of the package; shapes and units are part of it."""

import os
import pathlib
from typing import Any, Dict, Iterator, List, Literal, Optional, Sequence as Many, Tuple, Union

import numpy as np
from numpy.typing import NDArray

Path = Union[str, os.PathLike[str]]

__version__: str

class InputError(ValueError):
    """Bad input. The message names the file and the place, what was found there, and what to do about it."""

class Sequence:
    """A sequence folder in the MobileBrick layout.

    Opening reads poses and intrinsics; images are read when a frame is asked for them. It has a length, takes indices
    and can be pickled, so it works as a PyTorch map-style dataset as it is; ``collate_fn`` says what of the frames
    becomes tensors.
    """

    def __init__(self, path: Path) -> None: ...
    @property
    def name(self) -> str: ...
    @property
    def path(self) -> pathlib.Path: ...
    @property
    def image_size(self) -> Tuple[int, int]:
        """Width and height of the photographs, which intrinsics refer to."""
    @property
    def warnings(self) -> List[str]:
        """What was found and mended while opening."""
    def alignment(self) -> Alignment:
        """The result of ``mobilebrick align``; an InputError where there is none yet."""
    def __len__(self) -> int: ...
    def __getitem__(self, index: int) -> Frame: ...
    def __iter__(self) -> Iterator[Frame]: ...

class Frame:
    """One frame. Each access to an image reads its file; an InputError says that there is none, or what is wrong."""

    @property
    def id(self) -> int:
        """The number in its file names, which may have gaps."""
    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """[3, 3], pixels of the photograph."""
    @property
    def world_from_cam(self) -> NDArray[np.float64]:
        """[4, 4], the phone's pose."""
    @property
    def has_image(self) -> bool: ...
    @property
    def has_depth(self) -> bool: ...
    @property
    def image(self) -> NDArray[np.uint8]:
        """[H, W, 3], sRGB."""
    @property
    def depth(self) -> NDArray[np.float32]:
        """[h, w], the phone's depth in metres; smaller than the photograph."""
    @property
    def confidence(self) -> NDArray[np.uint8]:
        """[h, w], 0 to 2."""
    @property
    def gt_depth(self) -> NDArray[np.float32]:
        """[H, W], exact depth in metres."""
    @property
    def mask(self) -> NDArray[np.bool_]:
        """[H, W], true where the object is."""

class Alignment:
    """Where the object and the cameras are, as a stage of alignment found them."""

    def __init__(self, path: Path) -> None: ...
    @property
    def stage(self) -> Literal["keypoints", "refine", "bundle", "truth"]: ...
    @property
    def rms_px(self) -> Optional[float]: ...
    @property
    def world_from_object(self) -> NDArray[np.float64]:
        """[4, 4]."""
    @property
    def world_from_cam(self) -> Dict[int, NDArray[np.float64]]:
        """[4, 4] by frame id; frames that are absent keep the phone's pose."""

class Mesh:
    """Triangles, metres, counter-clockwise seen from outside. Without triangles it is a point cloud."""

    def __init__(self, vertices: NDArray[np.float64], triangles: Optional[NDArray[np.uint32]] = None) -> None:
        """``vertices`` [V, 3], ``triangles`` [T, 3] indices of vertices; without them a point cloud."""
    @staticmethod
    def read(path: Path) -> Mesh:
        """Reads PLY, OBJ, STL or GLB."""
    def write(self, path: Path) -> None:
        """Writes PLY, OBJ, STL or GLB by the extension; the file appears whole or not at all."""
    @property
    def vertices(self) -> NDArray[np.float64]:
        """[V, 3]."""
    @property
    def triangles(self) -> NDArray[np.uint32]:
        """[T, 3]."""

class Model:
    """A brick model."""

    def info(self) -> Dict[str, Any]:
        """Parts, triangles, boxes and parts list, as ``mobilebrick model info --json`` prints them."""
    def mesh(self, *, clearance_mm: float = 0.0) -> Mesh:
        """Every triangle in the object's frame: metres, y up."""

def load_model(path: Path, *, parts: Optional[Path] = None) -> Model:
    """Reads an LDraw model or a Studio archive; ``parts`` is the official library's folder or zip."""

def render_depth(
    mesh: Mesh,
    intrinsics: NDArray[np.float64],
    frame_from_cam: NDArray[np.float64],
    size: Tuple[int, int],
) -> NDArray[np.float32]:
    """Exact depth [H, W] of a mesh in metres, 0 where nothing is. ``intrinsics`` is [3, 3], ``frame_from_cam`` the
    camera's pose [4, 4] in the mesh's frame, ``size`` width and height."""

def fuse_tsdf(
    sequence: Sequence,
    *,
    voxel_size_mm: float = ...,
    truncation_mm: float = ...,
    min_depth_m: float = ...,
    max_depth_m: float = ...,
    min_confidence: int = ...,
    use_masks: bool = ...,
    min_weight: float = ...,
    color: bool = ...,
    poses: Literal["aligned", "phone"] = ...,
) -> Tuple[Mesh, Dict[str, Any]]:
    """Fuses a sequence's phone depth into a mesh in its world frame; returns it with a summary."""

def evaluate_surface(
    gt: Path,
    pred: Union[Path, Mesh],
    *,
    protocol: Literal["mobilebrick-2023", "exact-1", "dtu-style-1", "tnt-style-1"] = "mobilebrick-2023",
    points: Optional[int] = None,
    seed: int = 0,
    thresholds_mm: Many[float] = (),
) -> Dict[str, Any]:
    """Scores ``pred``, a mesh file or a mesh in memory, metres in the sequence's world frame, against the ground truth
    in the sequence folder ``gt``. ``thresholds_mm`` come beside 2.5 and 5 mm. The document is that of
    ``mobilebrick eval surface --json``; ``docs/metrics.md`` defines its keys."""

def evaluate_views(
    gt: Path,
    pred: Path,
    *,
    hold_out: Optional[int] = None,
    masks: Optional[Path] = None,
    lpips_net: Literal["vgg", "alex", "squeeze"] = "vgg",
    lpips_weights: Union[Path, Many[Path], None] = None,
) -> Dict[str, Any]:
    """Scores a folder of rendered images, paired by file name: PSNR, SSIM and, with weights, LPIPS."""

def evaluate_depth(gt: Path, pred: Path, *, confidence: Optional[Path] = None) -> Dict[str, Any]:
    """Scores a folder of depth maps: 16-bit PNGs in millimetres, paired by file name."""

def evaluate_poses(gt: Path, pred: Path) -> Dict[str, Any]:
    """Scores camera poses; each side is a sequence or any folder with ``pose/NNNNNN.txt``."""

def compare_depth(gt: NDArray[np.float32], pred: NDArray[np.float32]) -> Dict[str, Any]:
    """The metrics of two depth maps [H, W] in metres; a pixel counts where both are finite and above 0."""

def compare_images(gt: NDArray[np.float32], pred: NDArray[np.float32]) -> Dict[str, float]:
    """``psnr`` and ``ssim`` of two images [H, W, 3] with values from 0 to 1."""
