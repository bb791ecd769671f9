# SPDX-License-Identifier: Apache-2.0
"""Masks of photographs: search for their files by name, reading, and application to pixels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from clsplat.arrays import Float32
from clsplat.config.masks import NO_MASKS, MaskMeaning, MaskUse
from clsplat.errors import InputError, examples, warn
from clsplat.images.reading import IMAGE_SUFFIXES, find_images, image_size, read_image, stored_range
from clsplat.images.writing import write_image
from clsplat.scenes.dataset import PosedImage
from clsplat.scenes.sidecar_files import Named, bases_of, beside, inside, owned

MASK_FOLDERS = ("masks", "mask", ".masks", ".mask")
"""Names of the mask folder, next to the photographs' folder or inside it. RealityScan hides its mask folder."""
OTHER_MASK_FOLDERS = (
    *("images_mask", "images_masks", "image_mask", "image_masks", "masks_images", "masks_png", "dynamic_masks"),
    *("dynamic_mask", "mattes", "matte", "silhouettes", "silhouette", "segmentation", "segmentations"),
)
"""More names of mask folders. They are searched if masks are requested but not found in MASK_FOLDERS."""
DYNAMIC_FOLDER_PREFIX = "dynamic"
"""Prefix of the names of mask folders in which white may mark moving objects instead of kept pixels."""
MASK_THRESHOLD = 0.5
"""Minimum mask value of a kept pixel. In a resized mask, also the minimum kept fraction of a kept pixel's area."""
COMPARED_MASKS = 12
"""Approximate number of a folder's masks, evenly spaced, that are read to find out what an ambiguous mask means. Up to
twice as many may be read."""
VOID_LABEL = 255
"""Label of undefined pixels, as at the object borders in VOC and Cityscapes."""
MAX_LABEL = 40
"""Largest label except VOID_LABEL. A mask with larger values below a half is a soft mask, not a mask of labels."""
MAX_LABEL_NOISE_RATIO = 0.01
"""A mask counts as black and white with noise, not as labels, if the pixels with labels of 1 or more are fewer
than this fraction of the white pixels."""


@dataclass(frozen=True)
class Mask:
    """The mask of a photograph: a file, the photograph's alpha, or both.

    use: meaning of masked pixels, in the file and in alpha: ignored or transparent.
    path: the mask file, if there is one.
    """

    use: MaskUse
    path: Path | None = None

    @property
    def ignores(self) -> bool:
        """True if pixels of the photograph may be ignored in training."""
        return self.use.alpha == "ignore" or (self.path is not None and self.use.masks == "ignore")

    def applied(self, image: Float32, *, orient: bool) -> tuple[Float32, Float32 | None]:
        """Apply the mask to a photograph (H, W, 3 or 4).

        Returns the photograph, and an array (H, W, 1) with 1 for pixels that are kept and 0 for others, or None if
        all are kept. Raises InputError for a mask that has another size or does not decode.

        orient: rotate the mask by its EXIF orientation.
        """
        kept, counts = image[:, :, 3:] if image.shape[2] == 4 else None, None
        if kept is not None and self.use.alpha == "ignore":
            counts, kept = (kept >= MASK_THRESHOLD).astype(np.float32), None
        if self.path is not None:
            mask = read_mask(self.path, orient=orient, invert=self.use.invert)
            if mask.shape[:2] != image.shape[:2]:
                raise _misfit(self.path, (mask.shape[1], mask.shape[0]), (image.shape[1], image.shape[0]))
            if self.use.masks == "ignore":
                counts = mask if counts is None else counts * mask
            else:
                kept = mask if kept is None else kept * mask
        pixels = image[:, :, :3] if kept is None else np.concatenate([image[:, :, :3], kept], axis=2)
        return pixels, counts


def read_mask(path: Path, *, orient: bool, invert: bool) -> Float32:
    """Read a mask (H, W, 1): 1 for pixels that are kept, else 0.

    Pixels are kept if their grey value is at least a half; if the grey is constant, alpha is used instead. In a mask of
    labels (0 and 1, perhaps 255 for void), 1 is kept, and void never is. Raises InputError if the file does not
    decode, and for ambiguous labels. Also raises it if all values are below a half, and either the mask has only two
    values or the folder's other masks are dark too.

    orient: rotate the mask by its EXIF orientation.
    invert: exchange kept and other pixels.
    """
    image = read_image(path, orient=orient)
    pixels = image[:, :, :3]
    if image.shape[2] == 4 and np.ptp(pixels.mean(axis=2)) == 0:
        pixels = image[:, :, 3:]
    values = pixels.mean(axis=2, keepdims=True)
    dark = values[(values > 0) & (values < MASK_THRESHOLD)]
    if dark.size and values.max() < MASK_THRESHOLD:
        values = _from_labels(path, values, pixels)
    elif dark.size and dark.max() < (MAX_LABEL + 0.5) / VOID_LABEL and values[values >= MASK_THRESHOLD].min() == 1:
        values = _without_void(path, values)
    counts: Float32 = (((values >= MASK_THRESHOLD) != invert) & (values >= 0)).astype(np.float32)
    return counts


def _from_labels(path: Path, values: Float32, pixels: Float32) -> Float32:
    """Interpret a mask whose values are all below a half. In a mask of labels, label 1 becomes 1.0, and void -1.

    A soft mask is returned unchanged if another mask in its folder has values of at least a half.

    values: (H, W, 1), grey values of the mask, 0 to 1: means of its colours.
    pixels: (H, W, 1 or 3), colours of the mask, for the error message.
    Raises InputError for other labels, and for a soft mask if no mask in its folder has values of at least a half.
    """
    most, exact = stored_range(path)
    levels = np.unique(np.rint(values * most)).astype(int).tolist()
    if not most or levels[-1] < 1:
        return values
    if exact and levels[-1] == 1:
        return np.asarray(values * most, np.float32)
    if exact and levels[-1] == VOID_LABEL < most and set(levels[:-1]) in ({0, 1}, {1}):
        return _labels(np.rint(values * most), VOID_LABEL)
    if (len(levels) > 2 or not exact) and any(_reaches_half(other) for other in _like(path)):
        return values
    raise InputError(
        f"{path}: the mask's values are {_stored(pixels, most)}, all below a half, expected 0 and {most}, where a half "
        "or more is kept (or 0 and 1); make the pixels to keep white"
    )


def _stored(pixels: Float32, most: int) -> str:
    """Return pixel values (H, W, 1 or 3) as text for a message, scaled as stored in the file: 0 to `most`."""
    levels = np.unique(np.rint(pixels.reshape(-1, pixels.shape[2]) * most).astype(int), axis=0)
    if (levels == levels[:, :1]).all():
        grey = levels[:, 0].tolist()
        return " and ".join(map(str, grey)) if len(grey) < 3 else f"{len(grey)} from {grey[0]} to {grey[-1]}"
    colours = [f"({', '.join(map(str, colour))})" for colour in levels.tolist()]
    return " and ".join(colours) if len(colours) < 3 else f"{len(colours)} colours such as {examples(colours)}"


def _without_void(path: Path, values: Float32) -> Float32:
    """Interpret a mask of black, white and integers that may be labels. In a mask of labels, void becomes -1.

    The integers are labels if they cover at least the area of white, in this mask or in all masks of its folder. Raises
    InputError for labels other than 0 and 1, and if the meaning is ambiguous.

    values: (H, W, 1), grey values of the mask, 0 to 1.
    """
    most, exact = stored_range(path)
    areas = _areas(values, most)
    if not exact or areas is None:
        return values
    labels, void = areas
    several = bool((np.rint(values * most)[values < MASK_THRESHOLD] > 1).any())
    if labels < void:
        others = [_areas(read_image(other)[:, :, :3].mean(axis=2), most) for other in _like(path) if other != path]
        labels, void = (int(sum(each)) for each in zip(areas, *(other for other in others if other), strict=True))
    if labels < MAX_LABEL_NOISE_RATIO * void or (several and labels < void):
        return values
    if labels < void or several:
        found = ", ".join(map(str, np.unique(np.rint(values * most)).astype(int).tolist()[:-1]))
        what = "labels of several things and void" if several else "either labels 0 and 1 with void or black and white"
        raise InputError(
            f"{path}: the mask's values are {found} and {most}, {what}, expected 0 and {most} (values of at least a "
            "half are kept) or labels 0 and 1; make the pixels to keep white, and all others black"
        )
    return _labels(np.rint(values * most), most)


def _labels(levels: Float32, void: int) -> Float32:
    """Return a mask's labels `levels` with -1 in place of the label `void`."""
    return np.where(levels == void, np.float32(-1), levels).astype(np.float32)


def _areas(values: Float32, most: int) -> tuple[int, int] | None:
    """Return the number of pixels with labels from 1 to MAX_LABEL, and of white pixels, which may be void.

    Returns None if the mask has other values than such labels, black and white.

    values: grey values of the mask, 0 to 1.
    most: integer that the file stores for 1; 0 for a file of floats.
    """
    levels = values * most
    dark = levels < most * MASK_THRESHOLD
    whole = np.abs(levels - np.rint(levels)).max() < 0.25  # integers up to rounding: values are means of channels
    if not most or not whole or not (levels[~dark] > most - MASK_THRESHOLD).all() or (levels[dark] > MAX_LABEL).any():
        return None
    found = np.unique(np.rint(levels[dark])).astype(int).tolist()
    if found and found != list(range(found[0], found[-1] + 1)):
        return None
    return int(np.count_nonzero(dark & (levels > MASK_THRESHOLD))), int(np.count_nonzero(~dark))


def _like(path: Path) -> list[Path]:
    """Return about COMPARED_MASKS evenly spaced masks from the folder of the mask `path`, which may be among them.

    If `path` has "mask" in its name, the files with "mask" in their names are the masks, otherwise the files without.
    This leaves out photographs in the same folder.
    """
    named = "mask" in path.stem.lower()
    others = [other for other in find_images(path.parent, deep=False) if ("mask" in other.stem.lower()) == named]
    return others[:: max(len(others) // COMPARED_MASKS, 1)]


def _reaches_half(path: Path) -> bool:
    return bool(read_image(path)[:, :, :3].mean(axis=2).max() >= MASK_THRESHOLD)


def find_masks(
    folder: Path, names: Iterable[str], without: Iterable[Path] = (), *, strict: bool = True
) -> dict[str, Path]:
    """Find the masks in a folder. The keys are the names of their photographs.

    A mask is named IMAGE.jpg.png (COLMAP), IMAGE.png, IMAGE_mask.png or IMAGE.jpg.mask.png (RealityScan), in the same
    sub-folder. mask_0007.png may also belong to image_0007.png (`owned`). Raises InputError for a mask that fits no
    photograph, and for two masks of one photograph.

    names: names of all photographs, relative to their folder.
    without: files to skip.
    strict: if False, a mask that fits no photograph is skipped. Two masks of one photograph then raise InputError only
        if both have exact names.
    """
    names = sorted(names)
    example = next(iter(names), "IMAGE.jpg")
    return owned(
        folder, find_images(folder), _known(names), "mask", example, without=without, strict=strict, numbered=True
    )


def _known(names: Iterable[str], *, plain: bool = True) -> dict[str, str]:
    """Return each name that a mask may have, without extension, with the name of the mask's photograph.

    plain: also accept the photograph's own name for its mask.
    """
    known: dict[str, str] = {}
    for name in names:
        path = PurePosixPath(name)
        stem = str(path.with_suffix(""))
        own = (name, stem) if plain else (name,)
        before = (str(path.with_name(f"mask{mark}{path.stem}")) for mark in "_-")
        for key in (*own, *before, *(f"{each}{mark}mask" for each in (stem, name) for mark in "_.-")):
            known.setdefault(key, name)
    return known


def masks_of(use: MaskUse, images: Sequence[PosedImage], where: Path, *, strict: bool = True) -> dict[str, Mask]:
    """Find the masks of a scene's photographs, by the photographs' names; none if masks and alpha are not used.

    where: the scene, for messages.
    strict: raise InputError for a mask that fits no photograph. Must be False if photographs are missing: their
        masks may exist.
    Warns of photographs without a mask. Raises InputError if there are no masks, or one is missing, has another size,
    or fits no photograph.
    """
    if use == NO_MASKS:
        return {}
    found: dict[str, Path] = {}
    if use.masks != "none":
        told = {image.name: image.mask for image in images if image.mask is not None}
        found = {**masks_beside(images, told, strict=strict, others=OTHER_MASK_FOLDERS), **told}
        if not found:
            raise InputError(
                f"{where}: has no masks for --masks {use.masks}; expected masks/IMAGE.png beside images/, or "
                "'mask_path' in transforms.json"
            )
        files = {image.name: image.path for image in images}
        for name, path in found.items():
            size, photo = image_size(path, orient=False), image_size(files[name], orient=False)
            if size not in (photo, image_size(files[name], orient=True)):
                raise _misfit(path, size, photo)
        warn_of_sense(found.values(), use, where)
        if without := sorted(name for name in files if name not in found):
            warn(f"{where}: {len(without):,} photograph(s) have no mask and are used as a whole ({examples(without)})")
    return {image.name: Mask(use, found.get(image.name)) for image in images}


def warn_of_sense(masks: Iterable[Path], use: MaskUse, where: Path) -> None:
    """Warn of masks in a folder whose name suggests that white pixels are moving objects."""
    folder = next((path.parent for path in masks if path.parent.name.lower().startswith(DYNAMIC_FOLDER_PREFIX)), None)
    if folder is not None and not use.invert:
        warn(
            f"{where}: masks are in {folder.name}, and white pixels are the ones to keep, as in all masks; if white "
            "marks moving objects there, add --invert-masks"
        )


def masks_beside(
    images: Sequence[Named],
    told: Mapping[str, Path] | None = None,
    *,
    strict: bool = True,
    others: Sequence[str] = (),
) -> dict[str, Path]:
    """Find masks in a folder next to the photographs' folder or inside it, else next to each photograph.

    The keys are the names of the photographs.
    told: masks that the data set names, by photograph. These files are skipped.
    strict: if False, a mask that fits no photograph is skipped, as in `find_masks`.
    others: more names of folders, searched if the usual ones have no masks.
    Raises InputError like `find_masks`.
    """
    told = told or {}
    if all(image.name in told for image in images):
        return {}
    for folders in (MASK_FOLDERS, others) if others else (MASK_FOLDERS,):
        for base in bases_of(images):
            folder = beside(base, folders)
            if folder is not None:
                names = {str(PurePosixPath(image.path.relative_to(base).as_posix())): image.name for image in images}
                present = (
                    file.relative_to(base).as_posix() for file in find_images(base) if folder not in file.parents
                )
                masks = find_masks(folder, {*names, *present}, told.values(), strict=strict)
                if found := {names[key]: path for key, path in masks.items() if key in names}:
                    return found
        if found := _beside_each(images, told, folders, strict=strict):
            return found
    return {}


def _beside_each(
    images: Sequence[Named], told: Mapping[str, Path], folders: Sequence[str], *, strict: bool
) -> dict[str, Path]:
    """Find masks in a folder inside each photograph's own folder, or in the photograph's folder itself.

    In the photograph's folder, only files with "mask" or two extensions in their names are masks.

    told, strict: as for `masks_beside`. folders: names of mask folders.
    """
    by_parent: dict[Path, dict[str, str]] = {}
    for image in images:
        by_parent.setdefault(image.path.parent, {})[image.path.name] = image.name
    found: dict[str, Path] = {}
    for parent, names in by_parent.items():
        masks: dict[str, Path] = {}
        present = [path.name for path in find_images(parent, deep=False)]
        if (folder := inside(parent, folders)) is not None:
            masks = find_masks(folder, {*names, *present}, told.values(), strict=strict)
        if not masks:
            paths = [parent / name for name in present if name not in names and _says_mask(name)]
            masks = owned(parent, paths, _known(sorted(names), plain=False), "mask", "", strict=False)
        found.update({names[key]: path for key, path in masks.items() if key in names})
    return found


def _says_mask(name: str) -> bool:
    stem = PurePosixPath(name.lower()).stem
    return "mask" in stem or PurePosixPath(stem).suffix in IMAGE_SUFFIXES


def stage_mask(
    path: Path | None, target: Path, size: tuple[int, int], *, invert: bool, photo: Path | None = None
) -> None:
    """Write a black and white mask for a photograph to `target`, with white for kept pixels.

    path: the mask file, None for all white.
    size: the photograph's width and height.
    invert: exchange kept and other pixels of the mask file.
    photo: the photograph, if its alpha is a mask too.
    Raises InputError for a mask of another size.
    """
    mask = np.ones((*size[::-1], 1), np.float32)
    if path is not None:
        mask = read_mask(path, orient=False, invert=invert)
        if mask.shape[:2] != size[::-1]:
            raise _misfit(path, (mask.shape[1], mask.shape[0]), size)
    if photo is not None:
        mask = mask * (read_image(photo, orient=False)[:, :, 3:] >= MASK_THRESHOLD)
    target.parent.mkdir(parents=True, exist_ok=True)
    write_image(target, np.repeat(mask, 3, axis=2))


def for_sfm(use: MaskUse) -> MaskUse | None:
    """Return the use of masks in structure from motion, which finds no features in masked pixels; None for no masks.

    Raises InputError if masks and alpha have different meanings, as the reconstruction has one mask for both.
    """
    meanings = {use.masks, use.alpha} - {"none", "blend"}
    if len(meanings) > 1:
        raise InputError(
            f"--masks {use.masks} and --alpha {use.alpha}: expected the same meaning for a folder of photos, as their "
            "reconstruction combines both into one mask; make both the same, or give a scene with cameras"
        )
    if not meanings:
        return None
    masks: MaskMeaning = "none" if use.masks == "none" else "ignore"
    return MaskUse(masks, "blend" if use.alpha == "blend" else "ignore", use.invert)


def after_sfm(use: MaskUse, folder: Path) -> MaskUse:
    """Return how training uses the masks that structure from motion wrote: white is kept, and alpha is included.

    use: the meaning of the photographs' masks and alpha. folder: result of structure from motion.
    """
    if not (folder / MASK_FOLDERS[0]).is_dir():
        return replace(use, masks="none", invert=False)
    meaning: MaskMeaning = "none" if use.alpha == "blend" else use.alpha
    return replace(use, masks=meaning if use.masks == "none" else use.masks, invert=False)


def _misfit(path: Path, size: tuple[int, int], photo: tuple[int, int]) -> InputError:
    return InputError(
        f"{path}: the mask has {size[0]}x{size[1]} pixels, expected the size of its photograph, {photo[0]}x{photo[1]}; "
        "make it again in that size"
    )
