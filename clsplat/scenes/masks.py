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
from clsplat.images.reading import find_images, image_size, read_image
from clsplat.images.writing import write_image
from clsplat.scenes.beside import Named, bases_of, beside, owned
from clsplat.scenes.data_set import PosedImage

FOLDERS = ("masks", "mask")
"""Names of the folder of masks, beside the photographs' or in it."""
HALF = 0.5
"""Least value of a mask's pixel that counts, and least share of a pixel's area that counts where sizes differ."""


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
    grey. Raises InputError where it does not decode."""
    image = read_image(path, orient=orient)
    values = image[:, :, :3].mean(axis=2, keepdims=True)
    if image.shape[2] == 4 and values.min() == values.max():
        values = image[:, :, 3:]
    counts: Float32 = ((values >= HALF) != invert).astype(np.float32)
    return counts


def folder_of(images: Path) -> Path | None:
    """The folder of masks of a folder of photographs."""
    return beside(images, FOLDERS)


def find_masks(
    folder: Path, names: Iterable[str], without: Iterable[Path] = (), *, strict: bool = True
) -> dict[str, Path]:
    """The masks in a folder by the photographs' names, relative to theirs; names: of all the photographs that there
    are; without, strict: as of `owned`. A mask is called IMAGE.jpg.png as COLMAP's, IMAGE.png, or
    IMAGE_mask.png, in the same sub-folder.

    Raises InputError for a mask that fits no photograph, and for two of one.
    """
    known: dict[str, str] = {}
    for name in sorted(names):
        plain = PurePosixPath(name)
        stem = str(plain.with_suffix(""))
        for key in (name, stem, f"{stem}_mask", f"{stem}.mask", str(plain.with_name(f"mask_{plain.stem}"))):
            known.setdefault(key, name)
    example = next(iter(sorted(names)), "IMAGE.jpg")
    return owned(folder, find_images(folder), known, "mask", example, without=without, strict=strict)


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
    """The masks in the folder beside the photographs, or in theirs, by the photographs' names. told: masks that a file
    names, by the photographs' names; they are one for all in nerfstudio's scenes. Raises InputError as `find_masks`."""
    told = told or {}
    if all(image.name in told for image in images):
        return {}
    for base in bases_of(images):
        folder = folder_of(base)
        if folder is not None:
            names = {str(PurePosixPath(image.path.relative_to(base).as_posix())): image.name for image in images}
            others = (file.relative_to(base).as_posix() for file in find_images(base) if folder not in file.parents)
            masks = find_masks(folder, {*names, *others}, told.values(), strict=strict)
            return {names[key]: path for key, path in masks.items() if key in names}
    return {}


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
