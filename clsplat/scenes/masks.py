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
HALF = 0.5
"""Least value of a mask's pixel that counts, and least share of a pixel's area that counts where sizes differ."""
SOME = 12
"""Masks that are looked at, at most, to tell whether others reach a half."""


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
    grey; where the largest whole number in the file is 1, that does. Raises InputError where it does not decode, and
    where all values are dark: of two, or of more in masks that are all so."""
    image = read_image(path, orient=orient)
    values = image[:, :, :3].mean(axis=2, keepdims=True)
    if image.shape[2] == 4 and values.min() == values.max():
        values = image[:, :, 3:]
    if 0 < values.max() < HALF:
        values = _from_labels(path, values)
    counts: Float32 = ((values >= HALF) != invert).astype(np.float32)
    return counts


def _from_labels(path: Path, values: Float32) -> Float32:
    """Values of a mask that has none of a half or more, 1 for labels of 1. Raises InputError for other labels; a soft
    mask may be dark where another of its folder is not."""
    most, exact = stored_range(path)
    levels = np.unique(np.rint(values * most)).astype(int).tolist()
    if not most or levels[-1] < 1:
        return values
    if exact and levels[-1] == 1:
        return np.asarray(values * most, np.float32)
    if (len(levels) > 2 or not exact) and any(_reaches_half(other) for other in _like(path)):
        return values
    listed = " and ".join(map(str, levels)) if len(levels) < 3 else f"{len(levels)} from {levels[0]} to {levels[-1]}"
    raise InputError(
        f"{path}: the mask's values are {listed}, all of them dark, expected 0 and {most}, where a half or more counts "
        "(or 0 and 1); make white what counts"
    )


def _like(path: Path) -> list[Path]:
    """Some of the masks in a mask's folder, where photographs may be too."""
    named = "mask" in path.stem.lower()
    others = [other for other in find_images(path.parent, deep=False) if ("mask" in other.stem.lower()) == named]
    return others[:: max(len(others) // SOME, 1)]


def _reaches_half(path: Path) -> bool:
    return bool(read_image(path)[:, :, :3].mean(axis=2).max() >= HALF)


def folder_of(images: Path) -> Path | None:
    """The folder of masks of a folder of photographs."""
    return beside(images, FOLDERS)


def find_masks(
    folder: Path, names: Iterable[str], without: Iterable[Path] = (), *, strict: bool = True
) -> dict[str, Path]:
    """The masks in a folder by the photographs' names, relative to theirs; names: of all the photographs that there
    are; without, strict: as of `owned`. A mask is called IMAGE.jpg.png as COLMAP's, IMAGE.png, IMAGE_mask.png, or
    IMAGE.jpg.mask.png as RealityScan's, in the same sub-folder.

    Raises InputError for a mask that fits no photograph, and for two of one.
    """
    names = sorted(names)
    example = next(iter(names), "IMAGE.jpg")
    return owned(folder, find_images(folder), _known(names), "mask", example, without=without, strict=strict)


def _known(names: Iterable[str], *, plain: bool = True) -> dict[str, str]:
    """Photographs by the names, without the extension, that their masks may have; plain: also that of the photograph
    alone."""
    known: dict[str, str] = {}
    for name in names:
        path = PurePosixPath(name)
        stem = str(path.with_suffix(""))
        own = (name, stem) if plain else (name,)
        marked = (f"{stem}_mask", f"{stem}.mask", str(path.with_name(f"mask_{path.stem}")))
        for key in (*own, *marked, f"{name}.mask", f"{name}_mask"):
            known.setdefault(key, name)
    return known


def masks_of(use: MaskUse, images: Sequence[PosedImage], where: Path) -> dict[str, Mask]:
    """The masks of a scene's photographs, by their names; none if they mean nothing. where: the scene.

    Warns of photographs without a mask. Raises InputError where there are no masks, one is missing, of another size, or
    fits no photograph.
    """
    if use == NO_MASKS:
        return {}
    found: dict[str, Path] = {}
    if use.masks != "none":
        told = {image.name: image.mask for image in images if image.mask is not None}
        found = {**masks_beside(images, told), **told}
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
        if without := sorted(name for name in files if name not in found):
            warn(f"{where}: {len(without):,} photograph(s) have no mask and count as a whole ({examples(without)})")
    return {image.name: Mask(use, found.get(image.name)) for image in images}


def masks_beside(
    images: Sequence[Named], told: Mapping[str, Path] | None = None, *, strict: bool = True
) -> dict[str, Path]:
    """The masks in the folder beside the photographs, or in theirs, else beside each, by the photographs' names. told:
    masks that a file names, by the photographs' names; they are one for all in nerfstudio's scenes. Raises InputError
    as `find_masks`."""
    told = told or {}
    if all(image.name in told for image in images):
        return {}
    for base in bases_of(images):
        folder = folder_of(base)
        if folder is not None:
            names = {str(PurePosixPath(image.path.relative_to(base).as_posix())): image.name for image in images}
            others = (file.relative_to(base).as_posix() for file in find_images(base) if folder not in file.parents)
            masks = find_masks(folder, {*names, *others}, told.values(), strict=strict)
            if found := {names[key]: path for key, path in masks.items() if key in names}:
                return found
    return _beside_each(images, told, strict=strict)


def _beside_each(images: Sequence[Named], told: Mapping[str, Path], *, strict: bool) -> dict[str, Path]:
    """Masks in a folder in that of each photograph, or in that itself, where only names that say mask, or have two
    extensions, are masks."""
    by_parent: dict[Path, dict[str, str]] = {}
    for image in images:
        by_parent.setdefault(image.path.parent, {})[image.path.name] = image.name
    found: dict[str, Path] = {}
    for parent, names in by_parent.items():
        masks: dict[str, Path] = {}
        present = [path.name for path in find_images(parent, deep=False)]
        if (folder := inside(parent, FOLDERS)) is not None:
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
