"""Shape of an object from its silhouettes: background, visual hull and colors of its surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.frames import FrameSet, check_frame_set
from sylpose.geometry.arrays import BoolArray, FloatArray, Image
from sylpose.geometry.validation import check_list, check_type
from sylpose.mesh import Mesh
from sylpose.rig import Camera, Rig
from sylpose.silhouettes.background import OUTLINE_PX, Silhouette, estimate_background, find_silhouette, level_images
from sylpose.silhouettes.rendering import reduce_camera, reduce_image, reduce_mask, render_mesh, zoom_camera
from sylpose.silhouettes.visual_hull import (
    CORE_DEPTH,
    HullGrid,
    View,
    carve_region,
    measure_hull,
    measure_outline_distances,
)

# Images of a camera without masks that its background needs (measured: with 7, a turning object is background in a fifth
# of its pixels).
MIN_IMAGES = 15
# Pixels about the region that images are cropped to (derived: those of the outline's refinement).
CROP_MARGIN = 6
# Rounds of carving and of estimating the background where the hull is not (measured: the second changes the error of
# plain bodies from some percent of the size to 0.3; the third, less); masks need two for the region of the grid.
ROUNDS, ROUNDS_WITH_MASKS = 3, 2
# Halvings of the grid's spacing for the surface: 97 points along the longest side (measured: twice as many do not change
# the error).
REFINEMENTS = 1
# Images that show more than this share of the object's core as background are not used (choice: more than the outline's
# errors).
MAX_CORE_MISSED = 0.1
# Silhouettes are compared with the surface up to this share of its size around it (choice: other movers are farther).
NEAR_SHARE = 0.05
# A vertex's color is the mean of this many of the images that show it best (choice).
COLOR_IMAGES = 5


@dataclass(frozen=True, eq=False)
class CarvedObject:
    """Shape of an object from its silhouettes.

    Attributes:
        mesh: surface in the object's frame, with colors.
        spacing: distance of the grid's points, in the rig's unit.
        used: (F, C) images that were used; False without an image, where it does not show the object, and where its
            silhouette contradicts the others.
        contradicting: (F, C) images with such a silhouette.
        agreement: (F, C) area that surface and silhouette share, as a share of that of both together, near the object;
            NaN for images that were not used.
        unknown_outline: (F, C) share of the surface's outline next to which the background is not known: there nothing
            bounds the surface; NaN for images that were not used.
        noise: (C,) noise of the cameras, gray levels; NaN where masks are all silhouettes.
    """

    mesh: Mesh
    spacing: float
    used: BoolArray
    contradicting: BoolArray
    agreement: FloatArray
    unknown_outline: FloatArray
    noise: FloatArray


@dataclass(frozen=True, eq=False)
class _CameraImages:
    """Images of one camera.

    Attributes:
        camera: the camera of the reduced and cropped images.
        frames: numbers of the frames whose images show the object.
        images: theirs.
        masks: their silhouettes; None for what differs from the background.
        others: images that do not show the object, but its background; none where no background is needed.
    """

    camera: Camera
    frames: list[int]
    images: list[Image]
    masks: list[BoolArray | None]
    others: list[Image]

    @property
    def needs_background(self) -> bool:
        return any(mask is None for mask in self.masks)


def carve_object(rig: Rig, frames: Sequence[FrameSet], world_from_object: RigidTransform) -> CarvedObject:
    """Estimate the shape of an object from its silhouettes in frames with known poses.

    Masks in the frames are its silhouettes, and must be outlines of the object; an image with an empty one does not show
    it. In images without masks the silhouette is what differs from the camera's background, which needs at least 15
    images of this camera, spread over the recording: with fewer, only those with masks are used. Concave places that no
    silhouette shows are filled.

    Args:
        rig: the cameras.
        frames: some 31 frames from many sides; all images are held in memory.
        world_from_object: (F,) the object's pose in each frame, with its origin in or near the object.

    Raises:
        TypeError, ValueError: naming the argument: not frames of this rig, or not one pose for each; fewer than 15 images
            of a camera without masks; no image that shows the object; silhouettes that have nothing in common, or
            contradict each other; scikit-image is missing.
    """
    check_type(rig, Rig, "rig")
    frames = check_list(frames, FrameSet, "frames")
    for frame in frames:
        check_frame_set(frame, rig)
    check_type(world_from_object, RigidTransform, "world_from_object")
    if world_from_object.single or len(world_from_object) != len(frames) or not frames:
        raise ValueError(f"world_from_object must be one pose for each of the {len(frames)} frames, at least one")
    if not np.isfinite(world_from_object.as_matrix()).all():
        raise ValueError("world_from_object has poses that are not finite")
    places = world_from_object.translation
    cameras = [
        _collect_images(camera, [(f.images[c], f.masks[c]) for f in frames], _find_in_view(camera, places))
        for c, camera in enumerate(rig)
    ]
    low, high = _find_initial_region(cameras, places)
    hull: HullGrid | None = None
    noise = np.full(len(rig), np.nan)
    for _ in range(ROUNDS if any(of.needs_background for of in cameras) else ROUNDS_WITH_MASKS):
        views, silhouettes = list[View](), list[Silhouette]()
        if hull is not None:
            cameras = [_crop_to_region(of, low, high, world_from_object) for of in cameras]
        for c, of in enumerate(cameras):
            found, noise[c] = _find_silhouettes(of, hull, world_from_object)
            silhouettes += found
            for k, silhouette in zip(of.frames, found, strict=True):
                seen_from = replace(of.camera, camera_from_world=of.camera.camera_from_world * world_from_object[k])
                views.append(View(seen_from, measure_outline_distances(silhouette)))
        hull = carve_region(views, low, high, 0)
        low, high = _find_inner_region(hull)
    assert hull is not None
    numbers = [(k, c) for c, of in enumerate(cameras) for k in of.frames]
    is_used = _find_consistent_views(views, hull)
    mesh, spacing = _extract_surface([view for view, used in zip(views, is_used, strict=True) if used], low, high)
    used, contradicting = np.zeros((2, len(frames), len(rig)), bool)
    agreement, unknown_outline = np.full((2, len(frames), len(rig)), np.nan)
    rows, columns = np.array(numbers).T
    used[rows, columns], contradicting[rows, columns] = is_used, ~is_used
    for n in np.flatnonzero(is_used):
        agreement[numbers[n]], unknown_outline[numbers[n]] = _compare_silhouette(mesh, views[n], silhouettes[n])
    images = [image for of in cameras for image in of.images]
    colors = _color_vertices(mesh, [(views[n], images[n]) for n in np.flatnonzero(is_used)], spacing)
    return CarvedObject(replace(mesh, colors=colors), spacing, used, contradicting, agreement, unknown_outline, noise)


def _find_in_view(camera: Camera, places: FloatArray) -> BoolArray:
    """Return (F,) whether a cube about the object's places (F, 3) that fills the image is in it, at least in part."""
    pixels, size = camera.project(places), np.array(camera.size)
    is_near = np.abs(pixels - (size - 1) / 2) < (size + size.max()) / 2
    return np.asarray(is_near.all(axis=1) & (camera.camera_from_world.apply(places)[:, 2] > 0))


def _collect_images(
    camera: Camera, pairs: Sequence[tuple[Image | None, BoolArray | None]], is_in_view: BoolArray
) -> _CameraImages:
    """Collect a camera's images and masks, reduced to a handy size.

    Raises:
        ValueError: too few images for a background.
    """
    available = [k for k, (image, _) in enumerate(pairs) if image is not None]
    shown = [k for k in available if is_in_view[k] and ((mask := pairs[k][1]) is None or mask.any())]
    masked = [k for k in shown if pairs[k][1] is not None]
    if len(available) < MIN_IMAGES and len(masked) < len(shown):
        if not masked:
            raise ValueError(
                f"frames: camera {camera.name}: {len(available)} images without masks, of at least {MIN_IMAGES} from which "
                "its background can be estimated; give more frames, or masks of the object"
            )
        shown = masked
    needs_background = len(masked) < len(shown)
    kept = [*shown, *(k for k in available if needs_background and k not in shown)]
    images = list[Image]()
    for k in kept:
        image = pairs[k][0]
        assert image is not None
        images.append(reduce_image(image))
    if needs_background:
        images = level_images(images)
    masks = [None if (mask := pairs[k][1]) is None else reduce_mask(mask) for k in shown]
    return _CameraImages(reduce_camera(camera), shown, images[: len(shown)], masks, images[len(shown) :])


def _crop_to_region(
    of: _CameraImages, low: FloatArray, high: FloatArray, world_from_object: RigidTransform
) -> _CameraImages:
    """Crop a camera's images to where a box in the object's frame is in any of them."""
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3)
    pixels = np.concatenate(
        [of.camera.project(world_from_object[k].apply(corners)) for k in of.frames] or [corners[:0, :2]]
    )
    if not len(pixels) or not np.isfinite(pixels).all():
        return of
    first = np.clip(np.floor(pixels.min(axis=0)).astype(int) - CROP_MARGIN, 0, np.array(of.camera.size) - 1)
    last = np.clip(np.ceil(pixels.max(axis=0)).astype(int) + CROP_MARGIN, first, np.array(of.camera.size) - 1)
    window = slice(first[1], last[1] + 1), slice(first[0], last[0] + 1)
    camera = zoom_camera(of.camera, (first, last + 1))
    masks = [None if mask is None else mask[window] for mask in of.masks]
    images, others = ([image[window] for image in some] for some in (of.images, of.others))
    return _CameraImages(camera, of.frames, images, masks, others)


def _find_initial_region(cameras: Sequence[_CameraImages], places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the corners of a cube about the object's origin, at the places (F, 3), that fills the images.

    Raises:
        ValueError: no image shows the object.
    """
    sides = [
        np.median(of.camera.camera_from_world.apply(places[of.frames])[:, 2]) * max(of.camera.size) / of.camera.focal
        for of in cameras
        if of.frames
    ]
    if not sides:
        raise ValueError(
            "frames: no image shows the object: by world_from_object it is behind the cameras or far outside the images, "
            "all masks are empty, or there are no images"
        )
    side = float(np.median(sides))
    return np.full(3, -side / 2), np.full(3, side / 2)


def _find_silhouettes(
    of: _CameraImages, hull: HullGrid | None, world_from_object: RigidTransform
) -> tuple[list[Silhouette], float]:
    """Find the silhouettes of a camera, and its noise; images are not background where the hull may be in them."""
    if not of.needs_background:
        return [Silhouette.from_mask(mask) for mask in of.masks if mask is not None], np.nan
    covered = None
    if hull is not None:
        nowhere = np.zeros(of.images[0].shape[:2], bool)
        covered = [_cover(hull, of, world_from_object[k]) for k in of.frames] + [nowhere] * len(of.others)
    background = estimate_background(of.images + of.others, covered)
    silhouettes = [
        find_silhouette(background, image) if mask is None else Silhouette.from_mask(mask)
        for image, mask in zip(of.images, of.masks, strict=True)
    ]
    return silhouettes, background.noise


def _cover(hull: HullGrid, of: _CameraImages, pose: RigidTransform) -> BoolArray:
    """Return the pixels where the hull, and one spacing about it, may be."""
    mask: Image = np.zeros(of.images[0].shape[:2], np.uint8)
    points = pose.apply(hull.points(hull.near_surface(1.0)))
    pixels = of.camera.project(points)
    depth = of.camera.camera_from_world.apply(points)[:, 2]
    inside = (pixels >= 0) & (pixels <= np.array(mask.shape[::-1]) - 1)
    columns, rows = np.rint(pixels[inside.all(axis=1)]).astype(int).T
    mask[rows, columns] = 1
    if len(rows):
        reach = int(np.ceil(hull.spacing * of.camera.focal / depth[depth > 0].min()))
        mask = _dilate(mask > 0, reach)
    return mask > 0


def _find_inner_region(hull: HullGrid) -> tuple[FloatArray, FloatArray]:
    """Return the corners of a box about the hull.

    Raises:
        ValueError: nothing is in all silhouettes.
    """
    # A grid point is at most that many spacings from any point of a body.
    points = hull.points(hull.near_surface(0.5 * 3.0**0.5))
    if not len(points):
        raise ValueError(
            "the silhouettes have nothing in common: the poses are not those of what moves in front of the background, or "
            "the object looks like it; give masks of the object"
        )
    return points.min(axis=0) - 1.5 * hull.spacing, points.max(axis=0) + 1.5 * hull.spacing


def _find_consistent_views(views: Sequence[View], hull: HullGrid) -> BoolArray:
    """Return (n,) which images show the core of the hull, which nearly all images show deep inside, as foreground.

    Raises:
        ValueError: less than half of them do.
    """
    points = hull.points(hull.near_surface(0.0))
    core_depth = CORE_DEPTH * float(max(hull.distance.shape) - 1) * hull.spacing
    core = points[measure_hull(views, points, core_depth)[1] > core_depth] if len(points) else points
    if not len(core):  # a thin body has none
        return np.ones(len(views), bool)
    missed = np.array([np.mean(np.nan_to_num(view.sample(core)) < 0) for view in views])
    is_consistent = missed <= MAX_CORE_MISSED
    if is_consistent.mean() < 0.5:
        raise ValueError(
            f"the silhouettes contradict each other in {int((~is_consistent).sum())} of {len(views)} images: the poses are "
            "not those of what moves in front of the background, or the object looks like it; give masks of the object"
        )
    return is_consistent


def _extract_surface(views: Sequence[View], low: FloatArray, high: FloatArray) -> tuple[Mesh, float]:
    """Carve the hull finely and return its surface, and the grid's spacing."""
    try:
        from skimage.measure import marching_cubes
    except ImportError:
        raise ValueError("a surface needs scikit-image: python3 -m pip install 'sylpose[shape]'") from None
    grid = carve_region(views, low, high, REFINEMENTS)
    distance = np.pad(np.clip(grid.distance, -2 * grid.spacing, None), 1, constant_values=-2 * grid.spacing)
    if distance.max() <= 0:
        raise ValueError("the silhouettes have nothing in common: a few of them are wrong, or the object is too thin")
    vertices, faces, _, _ = marching_cubes(distance, 0.0, gradient_direction="ascent")
    return Mesh(grid.low + grid.spacing * (vertices - 1), faces).largest_part(), grid.spacing


def _compare_silhouette(mesh: Mesh, view: View, silhouette: Silhouette) -> tuple[float, float]:
    """Compare the surface with a silhouette.

    Returns:
        the area that both share, relative to that of both together, near the surface; the share of the surface's outline
        next to which the background is not known, 1 if it fills the image.
    """
    surface = render_mesh(mesh, view.camera, RigidTransform.identity()).mask
    rows, columns = np.nonzero(surface)
    if not len(rows):
        return 0.0, 1.0
    reach = int(np.ceil(NEAR_SHARE * max(np.ptp(rows), np.ptp(columns)))) + 1
    is_known = silhouette.log_odds != 0
    near = (_dilate(surface, reach) > 0) & is_known
    foreground = (silhouette.share > 0.5) & near
    both = (surface & near) | foreground
    outline = (_dilate(surface, OUTLINE_PX) > 0) & (_dilate(surface, 1) == 0)
    unknown = float(np.mean(~is_known[outline])) if outline.any() else 1.0
    return float((surface & foreground).sum() / max(both.sum(), 1)), unknown


def _dilate(mask: BoolArray, reach: int) -> Image:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8)), np.uint8)


def _color_vertices(mesh: Mesh, images: Sequence[tuple[View, Image]], spacing: float) -> Image:
    """Return colors (n, 3), RGB, of the vertices: means of the nearest and most frontal images that show them."""
    n, normals = len(mesh.vertices), mesh.vertex_normals
    weights, colors = np.zeros((len(images), n), np.float32), np.zeros((len(images), n, 3), np.uint8)
    for m, (view, image) in enumerate(images):
        camera = view.camera
        nearest = render_mesh(mesh, camera, RigidTransform.identity()).inverse_depth
        towards = camera.center - mesh.vertices
        distance = np.linalg.norm(towards, axis=1)
        frontal = (normals * towards).sum(axis=1) / distance
        pixels = camera.project(mesh.vertices)
        inside = np.asarray(((pixels >= 0) & (pixels <= np.array(image.shape[1::-1]) - 1)).all(axis=1))
        columns, rows = np.rint(np.where(inside[:, None], pixels, 0)).astype(int).T
        depth = camera.camera_from_world.apply(mesh.vertices)[:, 2]
        # The pixel's center may show a neighboring point of the surface.
        hidden = nearest[rows, columns] * (depth - 3 * spacing) > 1
        is_shown = np.asarray(inside & (frontal > 0) & ~hidden)
        weights[m] = np.where(is_shown, (frontal * camera.focal / distance) ** 2, 0)
        colors[m] = image[rows, columns, ::-1]
    best = np.argsort(-weights, axis=0)[:COLOR_IMAGES]
    weight = np.take_along_axis(weights, best, axis=0)[..., None]
    total = (weight * np.take_along_axis(colors, best[..., None], axis=0)).sum(axis=0)
    seen = weight.sum(axis=0)
    gray = total.sum(axis=0) / max(float(seen.sum()), 1e-9)  # where no image shows the surface
    return np.asarray(np.rint(np.where(seen > 0, total / np.maximum(seen, 1e-9), gray)), np.uint8)
