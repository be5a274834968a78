"""The morphable model: mean shape and albedo with linear modes, and what a pipeline must know of the mesh."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from mifit.core.arrays import read_npz
from mifit.core.calls import finite, whole
from mifit.core.files import replacing
from mifit.core.limits import MAX_NUMBER
from mifit.core.mesh import face_cross
from mifit.core.uv import rasterize_uv
from mifit.errors import InputError

_PROVIDED: dict[str, Callable[..., object]] = {}


def provide(method: str, function: Callable[..., object]) -> None:
    """Make a function what a method of `MorphableModel` calls.

    Formats and the built-in model are made of models, so they import this module and it imports none of them; they
    enter themselves here when ``mifit.morphable`` is imported.
    """
    _PROVIDED[method] = function


FORMAT_KEY = "mifit_model"
FORMAT_VERSION = 1
VERSION = 1
"""Of what is computed for a model: the built-in head, added eyes, what a file lacks. Raise it when that changes, since
results made with another version can't be read."""


@dataclass(frozen=True, eq=False)
class MorphableModel:
    """A linear model of face shape and albedo; immutable and validated on construction.

    Object space has y up and the nose along +z; coefficients are in standard deviations.

    Parameters
    ----------
    name : str
        What a person calls the model.
    mean : (V, 3) float32
        Mean shape, in units of ``unit_mm`` millimetres.
    faces : (F, 3) int32
        Vertex indices, counter-clockwise seen from outside.
    identity : (V, 3, Ki) float32
        Identity modes, premultiplied by their standard deviations.
    expression : (V, 3, Ke) float32
        Expression modes, likewise.
    mean_albedo : (V, 3) float32
        Mean diffuse albedo, linear Rec. 709 reflectance.
    albedo_modes : (V, 3, Ka) float32
        Albedo modes, premultiplied by their standard deviations.
    uv : (T, 2) float32
        Texture vertices; faces of ``face_mask`` lie in [0, 1].
    faces_uv : (F, 3) int32
        Texture-vertex indices per face.
    landmarks : (68,) int32
        Vertices of the 68 iBUG points.
    face_mask : (F,) bool
        Faces that enter photometric terms and the maps.
    symmetry : (V,) int32, optional
        For each vertex its mirror image's index in x -> -x.
    unit_mm : float
        Millimetres per model unit.
    expression_names : tuple of str
        One name per expression mode.
    expression_bounds : (Ke, 2) float32
        Lower and upper bounds of each expression coefficient; infinite when free.
    fingerprint : str
        What identifies a model whose arrays are partly computed: sums repeat only to rounding (their order depends
        on threads and memory), so its bytes can't. It holds for the content that it was given with, whose digest
        is added after a slash, and for no other. Empty for a model that is known by its content.

    Raises
    ------
    InputError
        An array has the wrong shape, is not finite, or an index is out of range; the message names it.
    """

    name: str
    mean: NDArray[np.float32]
    faces: NDArray[np.int32]
    identity: NDArray[np.float32]
    expression: NDArray[np.float32]
    mean_albedo: NDArray[np.float32]
    albedo_modes: NDArray[np.float32]
    uv: NDArray[np.float32]
    faces_uv: NDArray[np.int32]
    landmarks: NDArray[np.int32]
    face_mask: NDArray[np.bool_]
    symmetry: NDArray[np.int32] | None = None
    unit_mm: float = 10.0
    expression_names: tuple[str, ...] = ()
    expression_bounds: NDArray[np.float32] = None  # type: ignore[assignment]
    fingerprint: str = ""

    def __post_init__(self) -> None:
        v, f = len(np.atleast_1d(self.mean)), len(np.atleast_1d(self.faces))
        ke = np.shape(self.expression)[-1] if np.ndim(self.expression) == 3 else 0
        if self.expression_bounds is None:
            self._set("expression_bounds", np.tile([-np.inf, np.inf], (ke, 1)))
        if not self.expression_names:
            self._set("expression_names", tuple(f"expression_{k:02d}" for k in range(ke)))
        expected: dict[str, tuple[tuple, type]] = {
            "mean": ((v, 3), np.float32),
            "faces": ((f, 3), np.int32),
            "identity": ((v, 3, None), np.float32),
            "expression": ((v, 3, None), np.float32),
            "mean_albedo": ((v, 3), np.float32),
            "albedo_modes": ((v, 3, None), np.float32),
            "uv": ((None, 2), np.float32),
            "faces_uv": ((f, 3), np.int32),
            "landmarks": ((68,), np.int32),
            "face_mask": ((f,), np.bool_),
            "symmetry": ((v,), np.int32),
            "expression_bounds": ((ke, 2), np.float32),
        }
        for key, (shape, dtype) in expected.items():
            if key == "symmetry" and self.symmetry is None:
                continue
            self._set(key, _checked(self.name, key, getattr(self, key), shape, dtype))
        if v < 4 or f < 1:
            raise InputError(f"{self.name}: mean has {v} vertices and faces {f} rows, expected a surface")
        for key, limit in (("faces", v), ("faces_uv", len(self.uv)), ("landmarks", v), ("symmetry", v)):
            index = getattr(self, key)
            if index is not None and index.size and (index.min() < 0 or index.max() >= limit):
                raise InputError(
                    f"{self.name}: {key} holds indices {index.min()}..{index.max()}, expected 0..{limit - 1}"
                )
        if not self.face_mask.any():
            raise InputError(f"{self.name}: face_mask selects no face, expected at least one")
        if len(self.expression_names) != ke:
            raise InputError(f"{self.name}: {len(self.expression_names)} expression_names for {ke} modes")
        if not (np.isfinite(self.unit_mm) and self.unit_mm > 0):
            raise InputError(f"{self.name}: unit_mm is {self.unit_mm}, expected a positive number")
        if (self.expression_bounds[:, 0] > self.expression_bounds[:, 1]).any():
            raise InputError(f"{self.name}: expression_bounds has a lower bound above its upper bound")
        self._check_face()
        if self.fingerprint and "/" not in self.fingerprint:
            self._set("fingerprint", f"{self.fingerprint}/{self._content}")

    def _check_face(self) -> None:
        """Raise InputError where the face has no extent, in space or in the texture, or no skin's colour."""
        if not np.ptp(self.mean[self.landmarks], axis=0).any():
            raise InputError(f"{self.name}: all landmarks lie in one point, expected 68 places of a face")
        if not face_cross(self.mean.astype(np.float64), self.faces[self.face_mask]).any():
            raise InputError(f"{self.name}: faces: none of the face has an area, expected triangles")
        corners = self.uv[self.faces_uv[self.face_mask]].astype(np.float64)
        a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        within = ((corners > -0.01) & (corners < 1.01)).all(axis=(1, 2))
        if not (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])[within].any():
            raise InputError(f"{self.name}: uv: the face covers no part of the texture, expected coordinates in 0..1")
        middle = float(np.median(self.mean_albedo))
        if not -0.5 < middle < 2.0:
            raise InputError(f"{self.name}: mean_albedo: found a median of {middle:.3g}, expected reflectance in 0..1")

    def _set(self, key: str, value: object) -> None:
        object.__setattr__(self, key, value)

    # -- sizes --------------------------------------------------------------------------------------------

    @property
    def n_vertices(self) -> int:
        """Number of geometry vertices V."""
        return len(self.mean)

    @property
    def n_identity(self) -> int:
        """Number of identity modes Ki."""
        return self.identity.shape[2]

    @property
    def n_expression(self) -> int:
        """Number of expression modes Ke."""
        return self.expression.shape[2]

    @property
    def n_albedo(self) -> int:
        """Number of albedo modes Ka."""
        return self.albedo_modes.shape[2]

    # -- Jacobians: views of the bases, never copies ------------------------------------------------------

    @property
    def identity_jacobian(self) -> NDArray[np.float32]:
        """(3V, Ki) derivative of the flattened shape by identity coefficients; a view."""
        return self.identity.reshape(3 * self.n_vertices, -1)

    @property
    def expression_jacobian(self) -> NDArray[np.float32]:
        """(3V, Ke) derivative of the flattened shape by expression coefficients; a view."""
        return self.expression.reshape(3 * self.n_vertices, -1)

    @property
    def albedo_jacobian(self) -> NDArray[np.float32]:
        """(3V, Ka) derivative of the flattened albedo by albedo coefficients; a view."""
        return self.albedo_modes.reshape(3 * self.n_vertices, -1)

    # -- evaluation ---------------------------------------------------------------------------------------

    def shape(self, identity: ArrayLike | None = None, expression: ArrayLike | None = None) -> NDArray[np.float32]:
        """Vertices (V, 3) for coefficients in standard deviations, object space, in units of ``unit_mm`` millimetres.

        ``identity`` (<= Ki,) and ``expression`` (<= Ke,) may be shorter than the model's: missing ones are zero.
        """
        out = self.mean.ravel()
        if identity is not None:
            out = out + _product(self.identity_jacobian, identity, "identity", self.name)
        if expression is not None:
            out = out + _product(self.expression_jacobian, expression, "expression", self.name)
        return out.reshape(-1, 3).copy() if out.base is not None else out.reshape(-1, 3)

    def albedo(self, coefficients: ArrayLike | None = None) -> NDArray[np.float32]:
        """(V, 3) float32 linear reflectance for albedo coefficients in standard deviations; not clipped."""
        if coefficients is None:
            return self.mean_albedo.copy()
        out = self.mean_albedo.ravel() + _product(self.albedo_jacobian, coefficients, "albedo", self.name)
        return out.reshape(-1, 3)

    def sample(
        self, seed: int = 0, scale: float = 1.0
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Random coefficients, identity (Ki,), expression (Ke,) and albedo (Ka,), from the model's prior.

        The same seed gives the same subject; ``scale`` is a factor on the standard deviations. Expressions are clipped
        to their bounds.
        """
        rng, scale = np.random.default_rng(seed), float(finite(scale, (), "scale"))
        identity, expression, albedo = (
            (scale * rng.standard_normal(k)).astype(np.float32)
            for k in (self.n_identity, self.n_expression, self.n_albedo)
        )
        return identity, np.clip(expression, *self.expression_bounds.T), albedo

    # -- derived models -----------------------------------------------------------------------------------

    def subset(
        self,
        identity: int | slice | None = None,
        expression: int | slice | None = None,
        albedo: int | slice | None = None,
        region: NDArray[np.bool_] | None = None,
    ) -> MorphableModel:
        """The model with fewer modes or a smaller photometric region.

        Modes to keep are a number of leading ones, or a slice; all by default. ``region`` (F,) are faces that may stay
        in ``face_mask``. InputError for a number below 0, or a region of another shape.
        """

        def modes(kept: int | slice | None, name: str) -> slice:
            return kept if isinstance(kept, slice) else slice(kept if kept is None else whole(kept, 0, name))

        i, e, a = modes(identity, "identity"), modes(expression, "expression"), modes(albedo, "albedo")
        if region is not None and (np.shape(region) != self.face_mask.shape or np.asarray(region).dtype != bool):
            raise InputError(f"region: found shape {np.shape(region)}, expected {self.face_mask.shape} of bool")
        return replace(
            self,
            identity=np.ascontiguousarray(self.identity[:, :, i]),
            expression=np.ascontiguousarray(self.expression[:, :, e]),
            albedo_modes=np.ascontiguousarray(self.albedo_modes[:, :, a]),
            expression_names=self.expression_names[e],
            expression_bounds=self.expression_bounds[e],
            fingerprint="",
            face_mask=self.face_mask if region is None else self.face_mask & region,
        )

    @cached_property
    def mapped(self) -> NDArray[np.bool_]:
        """(F,) faces that maps hold: the face area, and charts that have a place of their own in the unit square."""
        corners = self.uv[self.faces_uv]
        own = self.face_mask | ((corners >= -1e-6) & (corners <= 1.0 + 1e-6)).all(axis=(1, 2))
        order = np.flatnonzero(own)
        maps = [rasterize_uv(self.uv, self.faces_uv[rows], 512) for rows in (order, order[::-1])]
        first, last = order[maps[0].face], order[::-1][maps[1].face]
        inner = (maps[0].weights.min(axis=1) > 1e-4) & (maps[1].weights.min(axis=1) > 1e-4)
        shared = np.concatenate([first[inner & (first != last)], last[inner & (first != last)]])
        # A chart goes as a whole: half of it would leave a ragged border.
        rest = np.flatnonzero(own & ~self.face_mask)
        corner = self.faces_uv[rest]
        links = (np.ones(corner.size), (corner.ravel(), np.roll(corner, 1, axis=1).ravel()))
        chart = sp.csgraph.connected_components(sp.coo_matrix(links, (len(self.uv),) * 2), directed=False)[1]
        spoiled = np.unique(chart[corner[np.isin(rest, shared), 0]])
        own[rest[np.isin(chart[corner[:, 0]], spoiled)]] = False
        return own

    @cached_property
    def degenerate_faces(self) -> NDArray[np.int64]:
        """Indices of the mean's faces without area; reported by ``mifit model info``."""
        area = np.linalg.norm(face_cross(self.mean.astype(np.float64), self.faces), axis=1)
        return np.flatnonzero(area <= 1e-12 * np.ptp(self.mean, axis=0).max() ** 2)

    @cached_property
    def digest(self) -> str:
        """Hexadecimal digest of all content but the name, or the fingerprint of content that is as it was given."""
        name, _, content = self.fingerprint.partition("/")
        return name if name and content == self._content else self._content

    @cached_property
    def _content(self) -> str:
        """Hexadecimal digest of all values but the name and the fingerprint."""
        h = hashlib.blake2b(digest_size=16)
        for f in fields(self):
            value = getattr(self, f.name)
            if isinstance(value, np.ndarray):
                h.update(f"{f.name}{value.shape}{value.dtype}".encode())
                h.update(value.data)
            elif f.name != "name":
                h.update(f"{f.name}={('' if f.name == 'fingerprint' else value)!r}".encode())
        return h.hexdigest()

    @property
    def source(self) -> str:
        """What `load` read the model from, an absolute path or ``"builtin"``; empty for a model made otherwise."""
        return str(self.__dict__.get("_source", ""))

    # -- files --------------------------------------------------------------------------------------------

    @classmethod
    def load(cls, path: str | Path, kind: str | None = None) -> MorphableModel:
        """Load a model, whatever its kind.

        ``path`` is ``"builtin"`` (about 15 000 vertices), ``"builtin:coarse"`` (about 9 000), ``"auto"`` (the model
        that ``mifit model fetch ict`` has fetched, else ``"builtin"``), or a file or folder of a known format,
        recognised by content; with ``+eyes`` behind it eyes are added. ``kind``, a key of ``recognise.KINDS``, sets the
        format.

        InputError where the file is missing, damaged or of no known kind; the message says what was found.
        """
        if isinstance(path, str) and path.partition("+")[0] == "auto":
            path = path.replace("auto", str(_PROVIDED["automatic"]()), 1)
        model = _PROVIDED["load"](path, kind)
        assert isinstance(model, MorphableModel)
        # Not a field: a model that is made from this one by `replace` is no longer the file's.
        named = isinstance(path, str) and path.partition(":")[0] == "builtin"
        model._set("_source", str(path) if named else str(Path(path).resolve()))
        return model

    def save(self, path: str | Path) -> None:
        """Write the model as an ``.npz`` file, whole or not at all; `load` gives back every array bit for bit.

        InputError where the path isn't ``.npz``.
        """
        if Path(path).suffix != ".npz":
            raise InputError(f"{path}: found suffix '{Path(path).suffix}', expected .npz")
        arrays = {f.name: np.asarray(getattr(self, f.name)) for f in fields(self) if f.name != "symmetry"}
        if self.symmetry is not None:
            arrays["symmetry"] = self.symmetry
        arrays[FORMAT_KEY] = np.asarray(FORMAT_VERSION)
        with replacing(path) as temporary:
            np.savez(temporary, **arrays)  # type: ignore[arg-type]


def load_own(path: Path) -> MorphableModel:
    """Read a model that `MorphableModel.save` wrote: fields under their names."""
    data = read_npz(path)
    version = data.pop(FORMAT_KEY)
    if version.shape != () or version != FORMAT_VERSION:
        raise InputError(f"{path}: {FORMAT_KEY} version {version}, expected {FORMAT_VERSION}")
    known = {f.name for f in fields(MorphableModel)}
    missing = sorted(known - {"symmetry", "fingerprint"} - set(data))
    if missing:
        raise InputError(f"{path}: lacks {', '.join(missing)}; expected every field of a mifit model")
    unit = data["unit_mm"]
    if unit.shape != () or unit.dtype.kind not in "fiu":
        raise InputError(f"{path}: unit_mm is {unit}, expected a number")
    values: dict = {k: v for k, v in data.items() if k in known}
    values |= {"name": str(data["name"]), "fingerprint": str(data.get("fingerprint", "")), "unit_mm": float(unit)}
    return MorphableModel(**values | {"expression_names": tuple(str(n) for n in data["expression_names"].ravel())})


def _checked(name: str, key: str, value: ArrayLike, shape: tuple, dtype: type) -> NDArray:
    """Return ``value`` as a read-only contiguous array of the given type, or raise InputError."""
    array = np.asarray(value)
    want = str(tuple("any" if n is None else n for n in shape)).replace("'", "")
    if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
        raise InputError(f"{name}: {key} has shape {array.shape}, expected {want}")
    if array.dtype.kind not in {"f": "fiu", "i": "iu", "b": "b"}[np.dtype(dtype).kind]:
        raise InputError(f"{name}: {key} has type {array.dtype}, expected {np.dtype(dtype)}")
    if dtype is np.int32 and array.size and (array.min() < -(2**31) or array.max() >= 2**31):
        raise InputError(f"{name}: {key} holds {array.max()}, expected 32-bit indices")
    with np.errstate(over="ignore"):
        array = np.ascontiguousarray(array, dtype=dtype)
    if dtype is np.float32 and key != "expression_bounds" and not (within := np.abs(array) <= MAX_NUMBER).all():
        bad = np.argwhere(~within)[0]
        expected = f"finite values within {MAX_NUMBER:g}"
        raise InputError(f"{name}: {key}[{', '.join(map(str, bad))}] is {array[tuple(bad)]}, expected {expected}")
    if key == "expression_bounds" and np.isnan(array).any():
        raise InputError(f"{name}: expression_bounds holds NaN")
    view = array.view()
    view.flags.writeable = False
    return view


def _product(basis: NDArray[np.float32], coefficients: ArrayLike, key: str, name: str) -> NDArray[np.float32]:
    """Basis times coefficients, of which trailing ones may be missing."""
    c = np.asarray(coefficients, dtype=np.float32)
    if c.ndim != 1 or len(c) > basis.shape[1]:
        raise InputError(f"{name}: {key} coefficients have shape {c.shape}, expected at most ({basis.shape[1]},)")
    if not np.isfinite(c).all():
        raise InputError(f"{name}: found {key} coefficients that are not finite, expected standard deviations")
    return basis @ c if len(c) == basis.shape[1] else basis[:, : len(c)] @ c
