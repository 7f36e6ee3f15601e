"""Features that separate hair from skin: gloss, colour and albedo.

A matte surface reflects a light as `albedo max(n·l, 0)`, less in shadow. Fibres reflect more than
the best matte fit under some lights: they mirror and transmit. That excess is the `gloss` of a
pixel; the contribution of noise is subtracted. Gloss is smooth over several pixels; colour is sharp
but does not determine which class is hair: `two_classes` learns it from certain hair pixels and
less glossy ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.special import logsumexp, softmax

from reconstruction.arrays import AnyFloats, Array, Bools, Ints
from reconstruction.capture.folder import Capture
from reconstruction.images.grey import grey
from reconstruction.images.silhouettes import background_noise

FEWEST_LIGHTS = 8
"""Least number of OLAT lights of a camera for the features."""

FAINTEST_GLOSS = float(np.log(0.12 + 0.03))
"""Log gloss, as in `looks`, exceeded by hair: rendered hair has a gloss of 0.2, skin 0.05."""

_CLEAR = 4.0
"""Standard deviations between the means of separate clusters: rendered hair and skin have 4.7 to
6.5, hair alone up to 3.6."""
_MATTE = 3.0
"""The same of hair and matte surfaces of its colour: 3.6 to 4.2 in rendered ones."""
_ENOUGH = 5.15
"""The same from which on two Gaussians suffice: 99.5 % of each lies on its own side."""
_KINDS = 4
"""Gaussians of hair, skin and cloth together: two of hair, or of skin."""
_RIGHT = 0.8
"""Share of known hair, and of known skin, that must be classified correctly."""
_ITERATIONS = 25
_SHADOWED = 0.5  # of the matte radiance: less is shadow
_LEAST_GLOSS = 0.03  # of a matte surface with indirect light
_MOST_PIXELS = 20_000  # used to estimate the classes
_BLOCK = 1 << 14
_LIKE_HAIR = 0.1  # share of hair that is no glossier than skin


def looks(capture: Capture, camera: str, subject: Bools, lights: int = 96) -> Array | None:
    """Features `(4, P)` of the P pixels of `subject (H, W)` from single-light frames.

    Log gloss (`matte_fit`); log ratios red/green and green/blue of the sum over lights that do not
    saturate the pixel; log albedo. Gloss and albedo are of 3×3 means. At most about `lights` lights
    are read. None with fewer than `FEWEST_LIGHTS` lights that reach the head, or without a subject.
    """
    names = [n for n in capture.olat_lights() if capture.has_light(n, camera)]
    names = [n for n in names if capture.rig.light(n).intensity_towards(np.zeros(3)).any()]
    if len(names) < FEWEST_LIGHTS or not subject.any():
        return None
    names = names[:: max(1, len(names) // lights)]
    near = ndimage.uniform_filter(subject.astype(np.float64), 3)[subject]
    values = np.empty((int(subject.sum()), len(names)), np.float32)
    known = np.empty(values.shape, bool)
    colour, noise = np.zeros((len(values), 3)), 0.0
    for k, name in enumerate(names):
        light = capture.rig.light(name)
        # a light that is nearer than the others would count as gloss
        square = float((light.position**2).sum())
        image, saturated = capture.light(name, camera)
        image = image * np.float32(square / light.intensity_towards(np.zeros(3)).mean())
        colour += np.where(saturated[subject][:, None], 0, image[subject])
        known[:, k] = ~ndimage.maximum_filter(saturated & subject, 3)[subject]
        mean = grey(image)
        noise += background_noise(mean) ** 2 / 9
        smooth = ndimage.uniform_filter(np.where(subject, mean, np.float32(0)), 3)
        values[:, k] = smooth[subject] / near
    directions = np.stack([capture.rig.light(n).position for n in names])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    gloss, albedo = matte_fit(values, directions, noise, known)
    faint = max(1e-3 * float(np.median(colour)), 1e-12)
    logs = np.log(np.maximum(colour, faint))
    red_to_green, green_to_blue = logs[:, 0] - logs[:, 1], logs[:, 1] - logs[:, 2]
    matte = np.log(np.maximum(albedo, faint / len(names)))
    return np.stack([np.log(gloss + _LEAST_GLOSS), red_to_green, green_to_blue, matte])


def matte_fit(
    values: AnyFloats, directions: Array, noise: float = 0.0, known: Bools | None = None
) -> tuple[Array, Array]:
    """Gloss and albedo `(N,)` of pixels with `values (N, L)` under lights from `directions`.

    Fits a matte surface `max(g·l, 0)`; values below half of it count as shadow. Gloss is the root
    of the energy above the surface as a share of the total, minus `noise`, the noise variance
    summed over lights; the albedo is |g| in `values`' units. `directions (L, 3)` are unit vectors.
    Values not `known (N, L)` are saturated: they do not enter the fit, and their excess is a lower
    bound.
    """
    outer = (directions[:, :, None] * directions[:, None]).reshape(len(directions), 9)
    gloss, albedo = np.zeros((2, len(values)))
    for begin in range(0, len(values), _BLOCK):
        block = np.s_[begin : begin + _BLOCK]
        v = np.asarray(values[block], np.float64)
        whole = np.ones(v.shape, bool) if known is None else known[block]
        lit = whole & (v > 0.25 * np.quantile(v, 0.95, axis=1, keepdims=True))
        for _ in range(4):
            moments = (lit @ outer).reshape(-1, 3, 3) + 1e-2 * np.eye(3)
            g = np.linalg.solve(moments, ((lit * v) @ directions)[..., None])[..., 0]
            matte = np.maximum(g @ directions.T, 0)
            lit = whole & (v > _SHADOWED * matte) & (matte > 0)
        # half of the noise is above zero
        above = (np.maximum(v - matte, 0) ** 2).sum(axis=1) - noise / 2
        energy = np.maximum((v**2).sum(axis=1) - noise, np.finfo(float).tiny)
        gloss[block] = np.sqrt(np.clip(above / energy, 0, 1))
        albedo[block] = np.linalg.norm(g, axis=1)
    return gloss, albedo


@dataclass(frozen=True, eq=False)
class TwoClasses:
    """Log odds of hair by K Gaussians with one covariance, of which `hair (K,)` are hair.

    Their log densities are `weights (K, 4)` times the features of `looks` plus `offsets (K,)`, up
    to a common term. `apart` is the distance of two Gaussians' means in common standard deviations.
    """

    weights: Array
    offsets: Array
    hair: Bools
    apart: float = 0.0

    @classmethod
    def same(cls, score: float) -> TwoClasses:
        """One log odds everywhere."""
        return cls(np.zeros((2, 4)), np.array([score, 0.0]), np.array([True, False]))

    def scores(self, looks: Array) -> Array:
        """Log odds `(...)` of hair for `looks (4, ...)`, clipped to ±5."""
        density = np.moveaxis(np.tensordot(self.weights, looks, 1), 0, -1) + self.offsets
        hair, other = (logsumexp(density[..., k], axis=-1) for k in (self.hair, ~self.hair))
        return np.asarray(np.clip(hair - other, -5, 5))


def clear_classes(looks: Array, measured: bool = True) -> TwoClasses | None:
    """Hair and skin among pixels with `looks (N, 4)`, without examples.

    Two Gaussians with one covariance, initialised by gloss. They must be `_CLEAR` apart and hair
    the glossier one. If gloss is `measured` under enough lights and its medians are on either side
    of `FAINTEST_GLOSS`, `_MATTE` suffices, as for cloth of the hair's colour, and `_components`
    separate them unless they are `_ENOUGH` apart. Otherwise None.
    """
    x = looks[_few(looks)]
    found = _mixture(x, [0, 1, 2, 3], np.zeros(len(x), bool), x[:, 0] < FAINTEST_GLOSS)
    hair = np.zeros(len(x), bool) if found is None else found.scores(x.T) > 0
    if found is None or not hair.any() or hair.all():
        return None
    gloss, other = np.median(x[hair, 0]), np.median(x[~hair, 0])
    if measured and _MATTE <= found.apart < _ENOUGH and other < FAINTEST_GLOSS < gloss:
        return _components(x, found)
    return found if found.apart >= _CLEAR and gloss > other else None


def two_classes(looks: Array, hair: Bools, measured: bool = True) -> TwoClasses:
    """Hair and skin among pixels with `looks (N, 4)`, of which `hair (N,)` are certainly hair.

    Without `clear_classes`, skin is sought among the other pixels with less gloss than nine in ten
    of the certain ones; if there are no more of them than in hair, all pixels are hair. If the
    classes overlap, all other pixels get the class of their majority. If the certain hair is matte,
    as with a misplaced head, all other pixels are skin.
    """
    if clear := clear_classes(looks, measured):
        return clear
    if np.median(looks[hair, 0]) < FAINTEST_GLOSS:
        return TwoClasses.same(-5.0)
    matte = ~hair & (looks[:, 0] < np.quantile(looks[hair, 0], _LIKE_HAIR))
    share = float(matte.sum() / max((~hair).sum(), 1))
    if share <= 2 * _LIKE_HAIR:
        return TwoClasses.same(5.0)
    pure = 1 - _LIKE_HAIR / share  # at most a tenth of the hair is among them
    other = TwoClasses.same(1.0 if share < 0.5 else -1.0)
    return split(looks, hair, matte, pure) or other


def split(looks: Array, hair: Bools, skin: Bools, pure: float = 1.0) -> TwoClasses | None:
    """Hair and skin among pixels with `looks (N, 4)`, estimated from examples of both.

    Two Gaussians with one covariance by expectation maximisation: `hair (N,)` stays hair, `skin
    (N,)` initialises the other class, of which at least a share `pure` is not hair. First by colour
    and albedo, then also by gloss, which is blurred and rises in hair's shadow. None unless
    `_RIGHT` of the hair and of the pure share of the skin is classified correctly.
    """
    few = _few(looks)
    x, hair, skin = looks[few], hair[few], skin[few]
    examples = hair if hair.any() else ~skin
    for columns in ([1, 2, 3], [0, 1, 2, 3]):
        classes = _mixture(x, columns, hair, skin)
        if classes is not None:
            odds = classes.scores(x.T)
            if (odds[examples] > 0).mean() > _RIGHT and (odds[skin] < 0).mean() > _RIGHT * pure:
                return classes
    return None


def _few(looks: Array) -> Ints:
    """Indices of the pixels used to estimate the classes."""
    return np.random.default_rng(0).permutation(len(looks))[:_MOST_PIXELS]


def _mixture(looks: Array, columns: list[int], hair: Bools, start: Bools) -> TwoClasses | None:
    """The classes by these `columns` of `looks (N, 4)`, at even priors; None if one vanishes.

    A prior would shift the boundary in pixels that show both classes.
    """
    x = looks[:, columns]
    skin = np.where(hair, 0.0, np.where(start, 0.95, 0.05))
    for _ in range(_ITERATIONS):
        classes = (1 - skin, skin)
        if min(w.sum() for w in classes) < 10:
            return None
        means = [np.average(x, axis=0, weights=w) for w in classes]
        within = sum(((x - m).T * w) @ (x - m) for w, m in zip(classes, means, strict=True))
        within = within / len(x) + 1e-8 * np.eye(x.shape[1])
        weights = np.linalg.solve(within, means[0] - means[1])
        offset = -0.5 * float(weights @ (means[0] + means[1]))
        prior = np.clip(skin[~hair].mean(), 0.02, 0.98)
        odds = np.clip(x @ weights + offset + np.log(1 / prior - 1), -30, 30)
        skin = np.where(hair, 0.0, 1 / (1 + np.exp(odds)))
    every = np.zeros((2, looks.shape[1]))
    every[0, columns] = weights
    apart = float(np.sqrt((means[0] - means[1]) @ weights))
    return TwoClasses(every, np.array([offset, 0.0]), np.array([True, False]), apart)


def _components(x: Array, classes: TwoClasses) -> TwoClasses:
    """The two `classes` of pixels with looks `x (N, 4)` as `_KINDS` Gaussians of one covariance.

    The widest is halved and all are estimated anew by expectation maximisation until there are as
    many. Hair lies above the largest gap between their mean gloss. Priors are even between hair and
    the rest.
    """
    share = 1 / (1 + np.exp(-classes.scores(x.T)))
    shares, scale = np.stack([share, 1 - share]), x.std(axis=0) + 1e-4
    while True:
        for _ in range(_ITERATIONS):
            size = shares.sum(axis=1)
            means = shares @ x / size[:, None]
            spread = [((x - m).T * w) @ (x - m) for m, w in zip(means, shares, strict=True)]
            within = sum(spread) / len(x) + 1e-3 * np.diag(scale**2)
            weights = np.linalg.solve(within, means.T).T
            offsets = np.log(size) - 0.5 * (weights * means).sum(axis=1)
            shares = softmax(weights @ x.T + offsets[:, None], axis=0)
        if len(means) == _KINDS:
            break
        axes = [np.linalg.eigh(s / np.outer(scale, scale)) for s in spread]
        widest = int(np.argmax([values[-1] for values, _ in axes]))
        side = ((x - means[widest]) / scale) @ axes[widest][1][:, -1] > 0
        shares = np.concatenate([shares, shares[widest : widest + 1] * side])
        shares[widest] *= ~side
    gloss = np.sort(means[:, 0])
    gap = int(np.argmax(np.diff(gloss)))
    hair = means[:, 0] > gloss[gap : gap + 2].mean()
    offsets -= np.where(hair, np.log(size[hair].sum()), np.log(size[~hair].sum()))
    return TwoClasses(weights, offsets, hair, classes.apart)
