"""Reference angles of joints from markers, marker clusters and orientations, by definitions that are stated.

Frames of segments: x to the right, y forward, z up (ISB's z, x, y). From landmarks (Wu et al. 2002, Cappozzo et al.
1995): z runs from the middle of the distal joint to the middle of the proximal one, x lies in the plane of z and the
line through the distal landmarks (epicondyles, malleoli), y = z × x. A cluster of three markers and more on a
segment carries its landmarks through the frames in which they are hidden (CAST, Cappozzo et al. 1995): nothing is
interpolated in time.

Definitions of a joint's angles, M the lower segment's frame seen from the upper one:

* ``isb``: M = Rx(a) Ry(b) Rz(c), the joint coordinate system of Grood and Suntay (1983): ``knee`` = −a,
  ``knee_abduction`` = −b, ``knee_rotation`` = −c.
* ``source``: the angle between the long axes of both segments in the sagittal plane, whose normal is the upper
  segment's x; ``knee`` = θ_thigh − θ_shank.
* without landmarks: the turn about one axis (twist of M). The axis is ``flexion_axis`` of the frames as they are, or
  the main axis of the relative turn, then zero in the first second, and positive where it turns farther.

Signs are the source's, upper − lower, for every definition: knee flexion is positive, hip flexion and
dorsiflexion are negative (ISB: positive); abduction and external rotation are positive on a right leg.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from .jointangles import FUNCTIONAL, AxisTurn, FloatArray, cardan, planar

SIDES = ("left", "right")
JOINTS = {"hip": ("trunk", "thigh"), "knee": ("thigh", "shank"), "ankle": ("shank", "foot")}
"""Joints: upper and lower segment."""
FARTHEST_M = 1e6
"""A marker farther than this from the origin of its room is none."""
RIGID_M = 0.02
"""Root mean square misfit of a cluster above which it is not called rigid."""

_ALIASES: dict[str, tuple[str, ...]] = {
    "hip": ("hip", "hjc", "hipcenter", "hipcentre", "hipjointcenter"),
    "trochanter": ("trochanter", "greatertrochanter", "gt", "gtr", "tro", "troch", "gtroch"),
    "knee": ("knee", "kjc", "kneecenter", "kneecentre"),
    "knee_lat": ("kneelat", "latknee", "kneelateral", "lateralknee", "kne", "lek", "lfe", "lfc", "fle", "kneeout",
                 "lateralepicondyle", "latepicondyle", "lepicondyle", "lepi", "klat"),
    "knee_med": ("kneemed", "medknee", "kneemedial", "medialknee", "mkne", "knem", "kneem", "knm", "mek", "mfe", "mfc",
                 "fme", "kneein", "medialepicondyle", "medepicondyle", "mepicondyle", "mepi", "kmed"),
    "ankle": ("ankle", "ajc", "anklecenter", "anklecentre"),
    "ankle_lat": ("anklelat", "latankle", "anklelateral", "lateralankle", "ank", "lmal", "malleoluslat", "fal", "lm",
                  "lateralmalleolus", "latmalleolus", "malleolus", "ankleout", "alat"),
    "ankle_med": ("anklemed", "medankle", "anklemedial", "medialankle", "mank", "ankm", "anm", "mmal", "malleolusmed",
                  "tam", "mm", "medialmalleolus", "medmalleolus", "anklein", "amed"),
    "heel": ("heel", "hee", "cal", "calc", "calcaneus", "fcc"),
    "toe": ("toe", "toetip", "toes", "mt2", "mtp2", "secondmetatarsal", "fm2", "toemid"),
    "asis": ("asis", "asi", "iasis", "ias"),
    "shoulder": ("shoulder", "sho", "acromion", "acromium", "acr"),
}  # fmt: skip
_OF_TRUNK = ("asis", "shoulder")
_ROLE = {alias: role for role, aliases in _ALIASES.items() for alias in aliases}
_SEGMENT = {
    "trunk": ("trunk", "back", "thorax", "pelvis", "pelv"),
    "thigh": ("thigh", "thi", "femur", "upperleg"),
    "shank": ("shank", "tib", "tibia", "lowerleg", "shin", "calf"),
    "foot": ("foot",),
}
_WORD = {word: segment for segment, words in _SEGMENT.items() for word in words}
_SIDE = {"l": "left", "left": "left", "lt": "left", "r": "right", "right": "right", "rt": "right"}


@dataclass(frozen=True)
class Anatomy:
    """What the markers of a capture are.

    Attributes
    ----------
    landmarks : dict
        (side, role) to the marker's place; side is empty where names have none.
    clusters : dict
        (side, segment) to the places of its markers.
    """

    landmarks: dict[tuple[str, str], int]
    clusters: dict[tuple[str, str], list[int]]

    @property
    def legs(self) -> list[str]:
        """Sides of the legs that have landmarks or clusters, empty for markers that name none."""
        sides = {side for side, role in self.landmarks if role not in _OF_TRUNK}
        sides |= {side for side, segment in self.clusters if segment != "trunk"}
        return [s for s in ("", *SIDES) if s in sides]


@dataclass
class ReferenceAngles:
    """Angles by name and attitudes by segment, (n,) rad and (n, 3, 3); NaN where not known.

    Attributes
    ----------
    angle, rot : dict
        By joint (``knee``, ``knee_abduction`` …) and by segment.
    remarks : dict of str to str
        Per joint: what it is made of and by which definition.
    doubts : list of str
        What the user must know, a line each.
    """

    angle: dict[str, FloatArray] = field(default_factory=dict)
    rot: dict[str, FloatArray] = field(default_factory=dict)
    remarks: dict[str, str] = field(default_factory=dict)
    doubts: list[str] = field(default_factory=list)


def name_of(marker: str) -> tuple[str, str]:
    """Return side (empty: none) and the rest of a marker's name, lower case without separators."""
    words = [w for w in re.split(r"[^a-z0-9]+", marker.rpartition(":")[2].lower()) if w]
    if len(words) > 1:
        for position in (0, -1):
            if words[position] in _SIDE:
                side = _SIDE[words.pop(position)]
                return side, "".join(words)
    whole = "".join(words)
    if _names_a_role(whole):
        return "", whole
    for word, side in (("left", "left"), ("right", "right"), ("l", "left"), ("r", "right")):
        if whole.startswith(word) and _names_a_role(whole[len(word) :]):
            return side, whole[len(word) :]
        if whole.endswith(word) and _names_a_role(whole[: -len(word)]):
            return side, whole[: -len(word)]
    return "", whole


def _names_a_role(rest: str) -> bool:
    return rest in _ROLE or _cluster_of(rest) is not None


def _cluster_of(rest: str) -> str | None:
    if match := re.fullmatch(r"(th|tb|sk|sh)\d", rest):
        return "thigh" if match[1] == "th" else "shank"
    return next((s for word, s in _WORD.items() if rest.startswith(word)), None)


def anatomy(names: Sequence[str], roles: Mapping[str, str] | None = None) -> Anatomy:
    """Return which marker is which landmark, and which form the cluster of a segment.

    Parameters
    ----------
    names : sequence of str
        Markers.
    roles : mapping, optional
        Marker to role as the user says it (``hip``, ``right_knee_lat``); goes before the names.

    Raises
    ------
    ValueError
        A given marker or role does not exist.
    """
    landmarks: dict[tuple[str, str], int] = {}
    clusters: dict[tuple[str, str], list[int]] = {}
    for marker, role in (roles or {}).items():
        side, _, plain = role.partition("_") if role.split("_")[0] in SIDES else ("", "", role)
        if marker not in names:
            raise ValueError(f"there is no marker {marker!r}; there are {', '.join(names)}")
        if plain not in _ALIASES:
            raise ValueError(f"{plain!r} is no landmark; there are {', '.join(_ALIASES)}")
        landmarks[side, plain] = list(names).index(marker)
    for k, name in enumerate(names):
        if name in (roles or {}):
            continue
        side, rest = name_of(name)
        role = _ROLE.get(rest)
        if role is not None:
            landmarks.setdefault((side, role), k)
        elif segment := _cluster_of(rest):
            clusters.setdefault((side, segment), []).append(k)
    return Anatomy(landmarks, {key: own for key, own in clusters.items() if len(own) >= 3})


def cluster_attitude(
    pos: FloatArray, shape: FloatArray | None = None
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return attitude and middle of a rigid cluster, its shape, and the misfit (Kabsch 1976).

    Parameters
    ----------
    pos : ndarray, shape (n, markers, 3)
        NaN where a marker is hidden; one farther than :data:`FARTHEST_M` is taken for hidden. Frames with fewer
        than three seen have no attitude.
    shape : ndarray, shape (markers, 3), optional
        Of the cluster, where it is known; else it is the mean of the frames in which all markers are seen.

    Returns
    -------
    rot, place, shape, misfit : ndarray (n, 3, 3), (n, 3), (markers, 3), float
        ``pos = place + rot @ shape``; NaN where not known; misfit in m (rms), NaN without a whole frame.
    """
    # LAPACK may work for ever on what overflowed.
    seen = np.asarray((np.abs(pos) < FARTHEST_M).all(axis=2))
    n, m = pos.shape[:2]
    lost = np.full((n, 3, 3), np.nan), np.full((n, 3), np.nan), np.full((m, 3), np.nan), float("nan")
    whole = np.flatnonzero(seen.all(axis=1))
    good = np.flatnonzero(seen.sum(axis=1) >= 3)
    if shape is None and not whole.size:
        return lost
    form = pos[whole[0]] - pos[whole[0]].mean(axis=0) if shape is None else shape
    if not good.size or np.linalg.svd(form, compute_uv=False)[1] < 0.005:
        return lost  # the markers lie on a line
    rot, place = lost[0], lost[1]
    filled, weight = np.where(seen[..., None], pos, 0.0)[good], seen[good].astype(float)
    count = weight.sum(axis=1)[:, None]
    for final in (False, True) if shape is None else (True,):
        middle = np.einsum("nmi,nm->ni", filled, weight) / count
        own = weight @ form / count
        spread = np.einsum(
            "nmi,nmj,nm->nij", filled - middle[:, None], form[None] - own[:, None], weight, optimize=True
        )
        u, _, vt = np.linalg.svd(spread)
        u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
        turned = u @ vt
        rot[good], place[good] = turned, middle - np.einsum("nij,nj->ni", turned, own)
        if not final:  # the mean shape instead of that of one frame
            form = np.einsum("nji,nmj->mi", rot[whole], pos[whole] - place[whole][:, None]) / len(whole)
    error = filled - (place[good][:, None] + np.einsum("nij,mj->nmi", rot[good], form))
    misfit = float(np.sqrt(np.sum(weight * np.sum(error**2, axis=2)) / weight.sum()))
    return rot, place, form, misfit


def place_in_cluster(point: FloatArray, rot: FloatArray, place: FloatArray) -> FloatArray | None:
    """Return where a landmark (n, 3) is in its cluster (3,); None if both are hardly ever seen together."""
    both = np.isfinite(point).all(axis=1) & np.isfinite(place).all(axis=1)
    if both.sum() < 10:
        return None
    return np.median(np.einsum("nji,nj->ni", rot[both], point[both] - place[both]), axis=0)


def carried(point: FloatArray, rot: FloatArray, place: FloatArray, own: FloatArray) -> FloatArray:
    """Return a landmark (n, 3), where it is hidden as its cluster, in which it is at ``own``, carries it (CAST)."""
    hidden = ~np.isfinite(point).all(axis=1)
    out = point.copy()
    out[hidden] = (place + rot @ own)[hidden]
    return out


def frame(z: FloatArray, x: FloatArray, *, along_x: bool = False) -> FloatArray:
    """Return attitudes (n, 3, 3) with z along ``z`` and x in their plane, or x along ``x``.

    NaN where they are parallel, or so long that their square is no number.
    """
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        z, x = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (z, x))
        y = np.cross(z, x)
        size = np.linalg.norm(y, axis=1, keepdims=True)
        y = np.where(size > 1e-6, y / size, np.nan)
    if along_x:
        return np.stack([x, y, np.cross(x, y)], axis=2)
    return np.stack([np.cross(y, z), y, z], axis=2)


def from_markers(
    t: FloatArray,
    names: Sequence[str],
    pos: FloatArray,
    definition: str,
    roles: Mapping[str, str],
    constants: dict[Any, Any] | None = None,
) -> ReferenceAngles:
    """Return the reference angles that a capture's markers say.

    Parameters
    ----------
    t : ndarray
        Times (s).
    names, pos : sequence of str, ndarray (n, markers, 3)
        Markers (m), NaN where hidden.
    definition : {"isb", "source"}
        See the module.
    roles : mapping
        Marker to landmark, as the user says.
    constants : dict, optional
        What does not change in a capture: filled by its first frames, used for the others, which come in windows.

    Raises
    ------
    ValueError
        A given marker or landmark does not exist.
    """
    body = anatomy(names, roles)
    legs = body.legs
    angles = ReferenceAngles()
    constants = {} if constants is None else constants
    trunk = _Side(names, pos, body, "", constants)
    if (rot := trunk.trunk_frame()) is not None:
        angles.rot["trunk"] = rot
    for side in legs:
        prefix = f"{side}_" if side and len(legs) > 1 else ""
        _leg(t, _Side(names, pos, body, side, constants), prefix, definition, angles)
    return angles


class _Side:
    """Markers of one leg, with what its clusters carry."""

    def __init__(
        self, names: Sequence[str], pos: FloatArray, body: Anatomy, side: str, constants: dict[Any, Any]
    ) -> None:
        self.pos, self.body, self.side, self._constants = pos, body, side, constants
        self.attitude: dict[str, tuple[FloatArray, FloatArray]] = {}
        self.doubts: list[str] = []
        for (own, segment), places in body.clusters.items():
            if own != side and segment != "trunk":
                continue
            key = side, "cluster", own, segment
            if key in constants:
                if constants[key] is not None:
                    rot, place, *_ = cluster_attitude(pos[:, places], constants[key])
                    self.attitude[segment] = rot, place
                continue
            rot, place, shape, misfit = cluster_attitude(pos[:, places])
            constants[key] = shape if misfit <= RIGID_M else None
            if misfit > RIGID_M:
                self.doubts.append(
                    f"{', '.join(names[k] for k in places)}: no rigid cluster ({1000 * misfit:.0f} mm rms, at most "
                    f"{1000 * RIGID_M:.0f}): not used"
                )
            elif np.isfinite(misfit):
                self.attitude[segment] = rot, place

    def once(self, key: str, value: Callable[[], Any]) -> Any:
        """Return what is constant of this leg: the value that the capture's first frames gave."""
        if (self.side, key) not in self._constants:
            self._constants[self.side, key] = value()
        return self._constants[self.side, key]

    def mark(self, role: str, segment: str, side: str | None = None) -> FloatArray | None:
        """Return a landmark (n, 3), carried by the segment's cluster where it is hidden."""
        k = self.body.landmarks.get((self.side if side is None else side, role))
        if k is None:
            return None
        point = self.pos[:, k]
        if segment not in self.attitude:
            return point
        own = self.once(f"marker {k} in {segment}", lambda: place_in_cluster(point, *self.attitude[segment]))
        return point if own is None else carried(point, *self.attitude[segment], own)

    def centre(self, joint: str, segment: str) -> FloatArray | None:
        """Return the middle of a joint: between its landmarks, else the one that there is."""
        lat, med = self.mark(f"{joint}_lat", segment), self.mark(f"{joint}_med", segment)
        if lat is not None and med is not None:
            return 0.5 * (lat + med)
        single = self.mark(joint, segment)
        return single if single is not None else lat

    def outwards(self, joint: str, segment: str) -> FloatArray | None:
        """Return the line from the medial to the lateral landmark."""
        lat, med = self.mark(f"{joint}_lat", segment), self.mark(f"{joint}_med", segment)
        return None if lat is None or med is None else lat - med

    def pelvis(self) -> FloatArray | None:
        """Return the line from the left to the right front of the pelvis."""
        left, right = self.mark("asis", "trunk", "left"), self.mark("asis", "trunk", "right")
        return None if left is None or right is None else right - left

    def trunk_frame(self) -> FloatArray | None:
        """Return the trunk's attitudes: x along the pelvis, z from hip (else the pelvis' front) to the shoulders."""
        right = self.pelvis()
        marks = [self.mark("shoulder", "trunk", s) for s in SIDES]
        hips = [self.mark("hip", "", s) for s in ("", *SIDES)]
        low = next((h for h in hips if h is not None), None)
        left, other = marks
        if right is None or left is None or other is None:
            return None
        if low is None:
            low = 0.5 * sum(self.pos[:, self.body.landmarks[s, "asis"]] for s in SIDES)
        return frame(0.5 * (left + other) - low, right, along_x=True)


def _leg(t: FloatArray, leg: _Side, prefix: str, definition: str, result: ReferenceAngles) -> None:
    result.doubts += leg.doubts
    hip = leg.mark("hip", "thigh")
    hip = hip if hip is not None else leg.mark("trochanter", "thigh")
    knee, ankle = leg.centre("knee", "thigh"), leg.centre("ankle", "shank")
    bend = (
        leg.once("bend", lambda: bent_about(hip - knee, knee - ankle))
        if hip is not None and knee is not None and ankle is not None
        else None
    )
    right: dict[str, FloatArray] = {}
    for joint, segment in (("knee", "thigh"), ("ankle", "shank")):
        if (line := leg.outwards(joint, segment)) is not None:
            sign = leg.once(f"right of the {joint}", partial(_to_the_right, leg, line, bend, result))
            right[segment] = line * sign
    if hip is not None and knee is not None and "thigh" in right:
        result.rot[f"{prefix}thigh"] = frame(hip - knee, right["thigh"])
    lower = right.get("shank", right.get("thigh"))
    if knee is not None and ankle is not None and lower is not None:
        result.rot[f"{prefix}shank"] = frame(knee - ankle, lower)
    heel, toe = leg.mark("heel", "foot"), leg.mark("toe", "foot")
    if heel is not None and toe is not None and lower is not None:
        result.rot[f"{prefix}foot"] = frame(np.cross(lower, toe - heel), lower)
    for joint, (up, low) in JOINTS.items():
        above, below = ("trunk" if up == "trunk" else f"{prefix}{up}"), f"{prefix}{low}"
        name = f"{prefix}{joint}"
        if above in result.rot and below in result.rot:
            if definition == "isb":
                angles = cardan(result.rot[above], result.rot[below])
                for k, tail in enumerate(("", "_abduction", "_rotation")):
                    result.angle[name + tail] = angles[:, k]
                result.remarks[name] = (
                    "isb: landmarks, Cardan angles x, y, z (Grood and Suntay 1983), upper - lower"
                )
            else:
                upper, lower_rot = result.rot[above], result.rot[below]
                result.angle[name] = planar(upper[:, :, 2], lower_rot[:, :, 2], upper[:, :, 0])
                result.remarks[name] = (
                    "source: long axes in the plane across the upper segment's x, upper - lower"
                )
        elif joint == "knee" and hip is not None and knee is not None and ankle is not None:
            plane = leg.pelvis()
            plane = bend if plane is None and bend is not None else plane
            if plane is not None:
                result.angle[name] = planar(hip - knee, knee - ankle, np.broadcast_to(plane, knee.shape))
                result.remarks[name] = (
                    "source: lines hip-knee-ankle in the plane across the pelvis, else where they bend, upper - lower"
                )
        elif joint != "ankle" and up in leg.attitude and low in leg.attitude:
            flexes = -1.0 if joint == "hip" else 1.0
            turn = leg.once(f"turn of the {joint}", partial(AxisTurn, None, flexes))
            angle = turn.angle(t, leg.attitude[up][0], leg.attitude[low][0])
            if angle is not None:
                result.angle[name] = angle
                result.remarks[name] = FUNCTIONAL


def bent_about(thigh: FloatArray, shank: FloatArray) -> FloatArray | None:
    """Return the unit normal (3,) of the plane in which a knee bends, to the right; None if it hardly bends."""
    normal = np.cross(shank, thigh)
    with np.errstate(invalid="ignore"):
        sine = np.linalg.norm(normal, axis=1) / (
            np.linalg.norm(thigh, axis=1) * np.linalg.norm(shank, axis=1)
        )
    bent = sine > np.sin(np.radians(15.0))  # False where NaN
    if bent.sum() < 10:
        return None
    mean = normal[bent].mean(axis=0)
    return mean / np.linalg.norm(mean)


def _to_the_right(leg: _Side, line: FloatArray, bend: FloatArray | None, angles: ReferenceAngles) -> float:
    """Return 1 where the line from medial to lateral points to the person's right, else −1."""
    by_name = {"left": -1.0, "right": 1.0}.get(leg.side)
    by_bend = None if bend is None else float(np.sign(np.nansum(line @ bend)))
    pelvis = leg.pelvis()
    by_pelvis = None if pelvis is None else float(np.sign(np.nansum(line * pelvis)))
    if by_name is not None:
        if by_bend is not None and by_bend != by_name:
            angles.doubts.append(
                f"the {leg.side} knee bends forward by its markers: sides, or medial and lateral, are exchanged"
            )
        return by_name
    sign = by_bend if by_bend is not None else by_pelvis
    if sign is None:
        angles.doubts.append("the leg's side is not known (no bend, no pelvis): taken for the right one")
        return 1.0
    return sign or 1.0
