# SPDX-License-Identifier: Apache-2.0
"""Masks of photographs: their files by name, and what they leave of the pixels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from clsplat.arrays import Float32
from clsplat.config.masks import NO_MASKS, MaskMeaning, MaskUse
from clsplat.errors import InputError, examples, warn
from clsplat.images.reading import EXTENSIONS, find_images, image_size, read_image, stored_range
from clsplat.images.writing import write_image
from clsplat.scenes.beside import Named, bases_of, beside, inside, owned
from clsplat.scenes.data_set import PosedImage

FOLDERS = ("masks", "mask", ".masks", ".mask")
"""Names of the folder of masks, beside the photographs' or in it; RealityScan's is hidden."""
OTHER_FOLDERS = (
    *("images_mask", "images_masks", "image_mask", "image_masks", "masks_images", "masks_png", "dynamic_masks"),
    *("dynamic_mask", "mattes", "matte", "silhouettes", "silhouette", "segmentation", "segmentations"),
)
"""Names of folders in which masks are looked for where there are none else, and they are asked for."""
DYNAMIC = "dynamic"
"""Beginning of a folder's name in which white may be what moves."""
HALF = 0.5
"""Least value of a mask's pixel that counts, and least share of a pixel's area that counts where sizes differ."""
SOME = 12
"""Masks that are looked at, at most, to tell whether others reach a half, or have void."""
VOID = 255
"""Label of what is neither, as VOC's and Cityscapes' borders."""
MOST_LABELS = 40
"""Largest of other labels; a soft mask has values beyond."""
STRAY = 0.01
"""Area of labels of 1, in that of 255, up to which these are noise in a mask of black and white."""


@dataclass(frozen=True)
class Mask:
    """The masks of a photograph. path: the file, if there is one; use: what it, and the photograph's alpha,
    mean."""

    use: MaskUse
    path: Path | None = None

    @property
    def ignores(self) -> bool:
        """True if pixels may have to be left out."""
        return self.use.alpha == "ignore" or (self.path is not None and self.use.masks == "ignore")

    def applied(self, image: Float32, *, orient: bool) -> tuple[Float32, Float32 | None]:
        """The photograph (H, W, 3 or 4) with the masks applied, and (H, W, 1) 1 where a pixel counts, 0 where not; None
        where all do. Raises InputError for a mask of another size, or that does not decode."""
        kept, counts = image[:, :, 3:] if image.shape[2] == 4 else None, None
        if kept is not None and self.use.alpha == "ignore":
            counts, kept = (kept >= HALF).astype(np.float32), None
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
    """(H, W, 1), 1 where a pixel counts and 0 where not: grey of a half or more does, or alpha where all is of one
    grey; of labels, 0 and 1, perhaps with 255 for void, 1 does, and void never. Raises InputError where it does not
    decode, where all values are dark (of two, or of more in masks that are all so), and for labels of which it cannot
    be told what counts."""
    image = read_image(path, orient=orient)
    pixels = image[:, :, :3]
    if image.shape[2] == 4 and np.ptp(pixels.mean(axis=2)) == 0:
        pixels = image[:, :, 3:]
    values = pixels.mean(axis=2, keepdims=True)
    dark = values[(values > 0) & (values < HALF)]
    if dark.size and values.max() < HALF:
        values = _from_labels(path, values, pixels)
    elif dark.size and dark.max() < (MOST_LABELS + 0.5) / VOID and values[values >= HALF].min() == 1:
        values = _without_void(path, values)
    counts: Float32 = (((values >= HALF) != invert) & (values >= 0)).astype(np.float32)
    return counts


def _from_labels(path: Path, values: Float32, pixels: Float32) -> Float32:
    """Values of a mask that has none of a half or more, 1 for labels of 1, -1 for void. Raises InputError for other
    labels; a soft mask may be dark where another of its folder is not. pixels: those that they are the means of."""
    most, exact = stored_range(path)
    levels = np.unique(np.rint(values * most)).astype(int).tolist()
    if not most or levels[-1] < 1:
        return values
    if exact and levels[-1] == 1:
        return np.asarray(values * most, np.float32)
    if exact and levels[-1] == VOID < most and set(levels[:-1]) in ({0, 1}, {1}):
        return _labels(np.rint(values * most), VOID)
    if (len(levels) > 2 or not exact) and any(_reaches_half(other) for other in _like(path)):
        return values
    raise InputError(
        f"{path}: the mask's values are {_stored(pixels, most)}, all of them dark, expected 0 and {most}, where a half "
        "or more counts (or 0 and 1); make white what counts"
    )


def _stored(pixels: Float32, most: int) -> str:
    """The values of pixels (H, W, 1 or 3) as in the file, for a line of text."""
    levels = np.unique(np.rint(pixels.reshape(-1, pixels.shape[2]) * most).astype(int), axis=0)
    if (levels == levels[:, :1]).all():
        grey = levels[:, 0].tolist()
        return " and ".join(map(str, grey)) if len(grey) < 3 else f"{len(grey)} from {grey[0]} to {grey[-1]}"
    colours = [f"({', '.join(map(str, colour))})" for colour in levels.tolist()]
    return " and ".join(colours) if len(colours) < 3 else f"{len(colours)} colours such as {examples(colours)}"


def _without_void(path: Path, values: Float32) -> Float32:
    """Values of a mask of black, white, and whole numbers that may be labels: 1 for labels of 1, -1 for void, if there
    is more of the labels, in the mask or in those of its folder. Raises InputError for more labels, and where it is
    open."""
    most, exact = stored_range(path)
    areas = _areas(values, most)
    if not exact or areas is None:
        return values
    labels, void = areas
    several = bool((np.rint(values * most)[values < HALF] > 1).any())
    if labels < void:
        others = [_areas(read_image(other)[:, :, :3].mean(axis=2), most) for other in _like(path) if other != path]
        labels, void = (int(sum(each)) for each in zip(areas, *(other for other in others if other), strict=True))
    if labels < STRAY * void or (several and labels < void):
        return values
    if labels < void or several:
        found = ", ".join(map(str, np.unique(np.rint(values * most)).astype(int).tolist()[:-1]))
        what = "labels of several things and void" if several else "labels of 0 and 1 with void, or black and white"
        raise InputError(
            f"{path}: the mask's values are {found} and {most}, {what}, expected 0 and {most}, where a half or more "
            "counts (or 0 and 1); make white what counts and black all else"
        )
    return _labels(np.rint(values * most), most)


def _labels(levels: Float32, void: int) -> Float32:
    """Labels, with -1 in place of void."""
    return np.where(levels == void, np.float32(-1), levels).astype(np.float32)


def _areas(values: Float32, most: int) -> tuple[int, int] | None:
    """Pixels of labels, 1 and so on, and of white, of a mask in which there is nothing else but black; else None."""
    levels = values * most
    dark = levels < most * HALF
    whole = np.abs(levels - np.rint(levels)).max() < 0.25  # a mean of three equal channels is whole but for rounding
    if not most or not whole or not (levels[~dark] > most - HALF).all() or (levels[dark] > MOST_LABELS).any():
        return None
    found = np.unique(np.rint(levels[dark])).astype(int).tolist()
    if found and found != list(range(found[0], found[-1] + 1)):
        return None
    return int(np.count_nonzero(dark & (levels > HALF))), int(np.count_nonzero(~dark))


def _like(path: Path) -> list[Path]:
    """Some of the masks in a mask's folder, where photographs may be too."""
    named = "mask" in path.stem.lower()
    others = [other for other in find_images(path.parent, deep=False) if ("mask" in other.stem.lower()) == named]
    return others[:: max(len(others) // SOME, 1)]


def _reaches_half(path: Path) -> bool:
    return bool(read_image(path)[:, :, :3].mean(axis=2).max() >= HALF)


def find_masks(
    folder: Path, names: Iterable[str], without: Iterable[Path] = (), *, strict: bool = True
) -> dict[str, Path]:
    """The masks in a folder by the photographs' names, relative to theirs; names: of all the photographs that there
    are; without, strict: as of `owned`. A mask is called IMAGE.jpg.png as COLMAP's, IMAGE.png, IMAGE_mask.png, or
    IMAGE.jpg.mask.png as RealityScan's, in the same sub-folder; or mask_0007.png for image_0007.png (`owned`).

    Raises InputError for a mask that fits no photograph, and for two of one.
    """
    names = sorted(names)
    example = next(iter(names), "IMAGE.jpg")
    return owned(
        folder, find_images(folder), _known(names), "mask", example, without=without, strict=strict, numbered=True
    )


def _known(names: Iterable[str], *, plain: bool = True) -> dict[str, str]:
    """Photographs by the names, without the extension, that their masks may have; plain: also that of the photograph
    alone."""
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
    """The masks of a scene's photographs, by their names; none if they mean nothing. where: the scene; strict:
    False where photographs are missing, whose masks may be there.

    Warns of photographs without a mask. Raises InputError where there are no masks, one is missing, of another size, or
    fits no photograph.
    """
    if use == NO_MASKS:
        return {}
    found: dict[str, Path] = {}
    if use.masks != "none":
        told = {image.name: image.mask for image in images if image.mask is not None}
        found = {**masks_beside(images, told, strict=strict, others=OTHER_FOLDERS), **told}
        if not found:
            raise InputError(
                f"{where}: --masks {use.masks}, and there are none; expected masks/IMAGE.png beside images/, or "
                "'mask_path' in transforms.json"
            )
        files = {image.name: image.path for image in images}
        for name, path in found.items():
            size, photo = image_size(path, orient=False), image_size(files[name], orient=False)
            if size not in (photo, image_size(files[name], orient=True)):
                raise _misfit(path, size, photo)
        warn_of_sense(found.values(), use, where)
        if without := sorted(name for name in files if name not in found):
            warn(f"{where}: {len(without):,} photograph(s) have no mask and count as a whole ({examples(without)})")
    return {image.name: Mask(use, found.get(image.name)) for image in images}


def warn_of_sense(masks: Iterable[Path], use: MaskUse, where: Path) -> None:
    """Warn of masks whose folder's name says that white may be what moves."""
    folder = next((path.parent for path in masks if path.parent.name.lower().startswith(DYNAMIC)), None)
    if folder is not None and not use.invert:
        warn(
            f"{where}: masks are in {folder.name}, and white is taken for what counts, as in all masks; if it is what "
            "moves there, give --invert-masks"
        )


def masks_beside(
    images: Sequence[Named],
    told: Mapping[str, Path] | None = None,
    *,
    strict: bool = True,
    others: Sequence[str] = (),
) -> dict[str, Path]:
    """The masks in the folder beside the photographs, or in theirs, else beside each, by the photographs' names. told:
    masks that a file names, by the photographs' names; they are one for all in nerfstudio's scenes. others: names of
    folders too, where there are none else. Raises InputError as `find_masks`."""
    told = told or {}
    if all(image.name in told for image in images):
        return {}
    for folders in (FOLDERS, others) if others else (FOLDERS,):
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
    """Masks in a folder in that of each photograph, or in that itself, where only names that say mask, or have two
    extensions, are masks."""
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
    return "mask" in stem or PurePosixPath(stem).suffix in EXTENSIONS


def stage_mask(
    path: Path | None, target: Path, size: tuple[int, int], *, invert: bool, photo: Path | None = None
) -> None:
    """Write a mask as black and white, for a photo of this width and height. path: its file; photo: the photo, whose
    alpha is a mask too. Raises InputError for another size."""
    mask = np.ones((*size[::-1], 1), np.float32)
    if path is not None:
        mask = read_mask(path, orient=False, invert=invert)
        if mask.shape[:2] != size[::-1]:
            raise _misfit(path, (mask.shape[1], mask.shape[0]), size)
    if photo is not None:
        mask = mask * (read_image(photo, orient=False)[:, :, 3:] >= HALF)
    target.parent.mkdir(parents=True, exist_ok=True)
    write_image(target, np.repeat(mask, 3, axis=2))


def for_sfm(use: MaskUse) -> MaskUse | None:
    """The use of masks in `clsplat.scenes.sfm`, where all that a mask leaves out has no features; None for none. Raises
    InputError for masks and alpha of two meanings: what is reconstructed has one mask for both."""
    meanings = {use.masks, use.alpha} - {"none", "blend"}
    if len(meanings) > 1:
        raise InputError(
            f"--masks {use.masks} and --alpha {use.alpha}: expected one meaning of both for a folder of photos, as "
            "their reconstruction has one mask for each; give the cameras, or make both the same"
        )
    if not meanings:
        return None
    masks: MaskMeaning = "none" if use.masks == "none" else "ignore"
    return MaskUse(masks, "blend" if use.alpha == "blend" else "ignore", use.invert)


def after_sfm(use: MaskUse, folder: Path) -> MaskUse:
    """The use of the masks in a folder that `clsplat.scenes.sfm` has made: white where a pixel counts, alpha among
    them."""
    if not (folder / FOLDERS[0]).is_dir():
        return replace(use, masks="none", invert=False)
    meaning: MaskMeaning = "none" if use.alpha == "blend" else use.alpha
    return replace(use, masks=meaning if use.masks == "none" else use.masks, invert=False)


def _misfit(path: Path, size: tuple[int, int], photo: tuple[int, int]) -> InputError:
    return InputError(
        f"{path}: the mask is {size[0]} x {size[1]} pixels, expected its photograph's {photo[0]} x {photo[1]}; "
        "make it of that size"
    )
