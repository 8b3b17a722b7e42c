"""`cadalign.Tracker`: the pose of an object in the newest frame of a running video."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, is_whole
from cadalign.errors import DegenerateError, InputError, NoConsensusError, require_kind
from cadalign.estimation.align import align
from cadalign.estimation.facing import require_perspective
from cadalign.estimation.joint_robust import under_cauchy, whitened_lengths
from cadalign.estimation.model import Model
from cadalign.estimation.options import FitOptions, RansacOptions
from cadalign.estimation.prepared_views import lie_on_a_line
from cadalign.estimation.prior import Lenses, prior_of
from cadalign.estimation.result import Result
from cadalign.estimation.search import JointProblem, thresholds
from cadalign.estimation.tracks.frames import Frames, SuccessiveErrors, candidates_of, weakened
from cadalign.estimation.tracks.motion import Motion, PoseAt, moved_by
from cadalign.estimation.tracks.smooth import EstimatedTrack, estimate_track
from cadalign.estimation.tracks.window import SeenMotion, Window, begun_again
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.joint.evidence import Evidence, Shape, points_of
from cadalign.solvers.joint.search import reduce_modes, reduced_state
from cadalign.solvers.joint.tracks import Path

_FIRST_FRAMES = 6  # with keypoints that determine a pose, from which the track begins
_FIRST_WITH_OUTLIERS = 12
_FORGOTTEN_AFTER = 15  # frames that contradict the track, at which it begins anew
_ITERATIONS = 12
_MOST_LOST = 0.5  # share of a frame's keypoints that agree, below which it contradicts the track
_LOST_AFTER = 4  # such frames in a row
_UNCERTAIN_DEG = 40.0  # standard deviation of the rotation at which the object counts as lost
_AGREE = 0.7  # share of the keypoints that agree with a pose at which the track goes on
_LEAST_SHARE = 0.6  # of all keypoints that agree where a track begins
_LEAST_FOUND = 4  # such keypoints


@dataclass(frozen=True, eq=False)
class TrackUpdate:
    """Estimate of the object after a frame, as `Tracker.update` returns it.

    Parameters
    ----------
    pose : PoseAt or None
        The pose in the frame that all views share, at the time of the view; None until enough
        frames determine it.
    inliers : (n,) bool
        The view's keypoints that agree with it.
    is_lost : bool
        The keypoints contradict the track, or there were none for long: the pose is a guess.
    is_new : bool
        The track begins with this frame, or begins anew where the keypoints alone place the object.
    """

    pose: PoseAt | None
    inliers: BoolArray
    is_lost: bool
    is_new: bool


class Tracker:
    """Track one object online: each frame updates a window of the last ones.

    What earlier frames say of shape, stretch and motion is kept as Gaussian information, so that
    an update takes the same few milliseconds however long the video is.

    Parameters
    ----------
    model : Model or ShapeModel
        As for `cadalign.align`.
    motion : Motion or "smooth"
        As for `cadalign.align`; a strength that is not given is that of all frames so far.
    lag : int
        Number of frames in the window, 3 or more.
    ransac : RansacOptions, optional
        Expect outliers, among the keypoints and among frames.

    Raises
    ------
    InputError
        If an argument is invalid.

    Examples
    --------
    >>> from cadalign import Camera
    >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    >>> camera = Camera(640, 480, 900, 900, 319.5, 239.5)
    >>> tracker = Tracker(Model(points_3d=corners, stretch="none"))
    >>> for k in range(9):
    ...     pose = Alignment(np.diag([-1.0, -1.0, 1.0]), [0.3 + 0.01 * k, 0.2, 6.0], np.ones(3))
    ...     newest = tracker.update(View(camera, camera.project(pose.apply(corners)), time=k / 30))
    >>> newest.is_lost, round(float(newest.pose.alignment.translation[0]), 3)
    (False, 0.38)
    """

    def __init__(
        self,
        model: Model | ShapeModel,
        *,
        motion: Motion | str = "smooth",
        lag: int = 10,
        ransac: RansacOptions | None = None,
    ) -> None:
        if not is_whole(lag) or lag < 3:
            raise InputError(f"{lag!r} is not a whole number from 3 on", where="lag")
        if ransac is not None:
            require_kind(ransac, RansacOptions, "ransac")
        self._model, self._motion, self._lag, self._ransac = model, Motion.of(motion), lag, ransac
        self._prior = prior_of(model)
        self._views: list[View] = []
        self._recent: list[View] = []
        self._window: Window | None = None
        self._seen_motion: SeenMotion
        self._shape: Shape | None = None
        self._contradicting = 0
        self._is_lost = False
        self._errors = SuccessiveErrors()
        self._noise = 1.0  # of keypoints without a sigma [px], from where the track begins

    @property
    def is_lost(self) -> bool:
        """True if the last update lost the object, or none has found it yet."""
        return self._window is None or self._is_lost

    @property
    def views(self) -> Sequence[View]:
        """All views so far."""
        return tuple(self._views)

    @property
    def points_3d(self) -> FloatArray | None:
        """Keypoints (m, 3) of the object in the model's frame, with its stretch; None at first."""
        if self._window is None:
            return None
        points = points_of(self._window.evidence.shape, self._window.path.state)
        return points[: len(self._prior.ids)]

    def smooth(self) -> Result:
        """The whole track, as `cadalign.align` estimates it from all views."""
        return align(self._model, self._views, motion=self._motion, ransac=self._ransac)

    def update(self, view: View) -> TrackUpdate:
        """Take a frame; returns the newest estimate.

        Raises
        ------
        InputError
            If it is no `View`, of a wide lens, has no time, or one that is not later than the last,
            or its evidence is none of the model's; the track is then as it was.
        """
        require_kind(view, View, "view")
        if view.time is None:
            raise InputError("a tracked view needs one", where="view.time", fix="give seconds")
        if self._views and float(view.time) <= float(self._views[-1].time or 0.0):
            what = f"{view.time} is not later than {self._views[-1].time}, that of the last view"
            raise InputError(what, where="view.time")
        require_perspective(view.camera, "a tracker")
        for name in ("mask", "image"):
            if getattr(view, name) is not None:
                what = "a tracker follows keypoints, not outlines"
                fix = "leave it away, or align the frame from the last pose: align(..., init=)"
                raise InputError(what, where=f"view.{name}", fix=fix)
        self._refuse_foreign(view)
        self._views.append(view)
        self._recent.append(view)
        if self._window is None:
            return self._begun(view)
        window = self._grown(self._window, view)
        tried = [window.refined(_ITERATIONS)]
        share = self._agreement(tried[0][1])
        if share.size and share.mean() < _AGREE:
            tried += [self._from(window, pose).refined(_ITERATIONS) for pose in self._found(view)]
        _, window = min(tried, key=lambda each: each[0])
        inliers = self._agreement(window)
        if share.size and inliers.mean() >= _AGREE:
            last = len(window.times) - 2
            newest = SuccessiveErrors.of(window.evidence, window.path.state, first=last)
            sums = zip(self._errors, newest, strict=True)
            self._errors = SuccessiveErrors(*(before + new for before, new in sums))
        if len(inliers):
            contradicts = inliers.mean() < _MOST_LOST
            self._contradicting = self._contradicting + 1 if contradicts else 0
        turn = max(float(np.trace(window.newest()[:3, :3])), 0.0)
        is_open = not np.degrees(np.sqrt(turn)) < _UNCERTAIN_DEG
        self._is_lost = self._contradicting >= _LOST_AFTER or is_open
        again = self._again(view, window) if self._is_lost else None
        if again is not None:
            window, inliers = again, self._agreement(again)
        elif self._contradicting >= _FORGOTTEN_AFTER:
            self._window = None
            return self._begun(view)
        self._window = self._shortened(window)
        return self._told(view, inliers, again is not None)

    def _refuse_foreign(self, view: View) -> None:
        """Refuse a view that does not go with the model or with the views before."""
        if self._views and (view.cam_from_rig is None) != (self._views[0].cam_from_rig is None):
            what, fix = "only some views have a known pose", "give it for all views, or for none"
            raise InputError(what, where="view.cam_from_rig", fix=fix)
        try:
            problem = self._problem([view], [0])
            problem.evidence(self._prior.components[0], problem.lenses)
        except InputError as error:
            where = (error.where or "view").replace("views[0]", "view")
            raise InputError(error.what, where=where, fix=error.fix) from None

    def _begun(self, view: View) -> TrackUpdate:
        """Begin the track where the views so far determine poses."""
        mean = self._prior.components[0].mean
        rows = [self._prior.rows_of(each.keypoint_ids, "view.ids") for each in self._recent]
        told = [not lie_on_a_line(mean[own]) for own in rows]
        nothing = TrackUpdate(None, np.ones(len(view.keypoint_ids), dtype=bool), True, False)
        first = _FIRST_FRAMES if self._ransac is None else _FIRST_WITH_OUTLIERS
        if sum(told) < first:
            return nothing
        del self._recent[: -max(self._lag, first)]
        frames, unknown = Frames.of(self._recent), [None] * len(self._recent)
        problem = self._problem(self._recent, frames.of_view.tolist())
        try:
            # Of few frames it cannot be told if errors correlate.
            found = estimate_track(
                problem, frames, self._motion, unknown, self._ransac, may_correlate=False
            )
        except (DegenerateError, NoConsensusError):
            return nothing
        if found.inliers.mean() < _LEAST_SHARE:
            return nothing
        self._noise = found.problem.noise
        evidence, path = self._with_all_modes(found)
        times = np.array([each.time for each in self._recent], dtype=float)
        window = Window(evidence, times, path, found.motion)
        _, window = window.refined(_ITERATIONS)
        if self._fits(window).mean() < _LEAST_SHARE:
            return nothing
        per_frame, seconds = found.motion.told, found.motion.seconds
        count = 1.0 / per_frame if per_frame > 0 else len(seconds) + 1.0
        # The first frames suggest its strength as one residual would.
        self._seen_motion = SeenMotion(found.motion.strength**2, np.ones(2), count)
        window = self._shortened(window)
        self._window, self._is_lost, self._contradicting = window, False, 0
        return self._told(view, self._agreement(window), True)

    def _shortened(self, window: Window) -> Window:
        """The window without frames beyond its lag, with what these showed of the motion."""
        while len(window.times) > self._lag:
            self._seen_motion = self._seen_motion.after(window)
            window = window.without_first()
            self._recent.pop(0)
        return replace(window, prior=self._seen_motion.prior(window.prior, self._motion))

    def _problem(self, views: Sequence[View], frames: Sequence[int]) -> JointProblem:
        lenses = Lenses.of(views, "known", None)
        return JointProblem(
            self._prior, views, None, FitOptions(), lenses, self._noise, frames=tuple(frames)
        )

    def _with_all_modes(self, found: EstimatedTrack) -> tuple[Evidence, Path]:
        """Evidence and path in modes that suffice for all keypoints."""
        shape, ids = self._prior.components[found.minima[0].component], self._prior.ids
        whole = View(self._recent[0].camera, np.zeros((len(ids), 2)), ids=ids)
        problem = self._problem([whole, whole], (0, 1))
        reduction = reduce_modes(problem.evidence(shape, problem.lenses))
        self._shape = reduction.evidence.shape
        state = reduced_state(reduction, shape, found.path.state)
        return self._evidence(), found.path._replace(state=state)

    def _evidence(self) -> Evidence:
        views, shape = self._recent, self._shape
        assert shape is not None
        problem = self._problem(views, range(len(views)))
        evidence = problem.evidence(shape, problem.lenses)
        evidence = weakened(evidence, self._errors.correlation)
        return evidence if self._ransac is None else under_cauchy(evidence)

    def _grown(self, window: Window, view: View) -> Window:
        """The window with a further frame, at which its velocity would lead."""
        time, state = float(view.time or 0.0), window.path.state
        velocity = window.path.velocities[-1]
        ahead = moved_by(state.poses[-1], (time - window.times[-1]) * velocity)
        path = Path(
            state._replace(poses=np.vstack([state.poses, ahead])),
            np.vstack([window.path.velocities, velocity]),
        )
        times = np.append(window.times, time)
        return replace(window, evidence=self._evidence(), times=times, path=path)

    def _from(self, window: Window, pose: FloatArray) -> Window:
        """The window with another start of its last frame."""
        state = window.path.state
        poses = np.vstack([state.poses[:-1], pose])
        return replace(window, path=window.path._replace(state=state._replace(poses=poses)))

    def _found(self, view: View) -> FloatArray:
        """Poses (C, 12) that the view's own keypoints suggest for the object's shape."""
        assert self._window is not None
        problem = self._problem([view], [0])
        evidence = problem.evidence(self._prior.components[0], problem.lenses)
        shape = points_of(self._window.evidence.shape, self._window.path.state)
        found = candidates_of(under_cauchy(evidence), shape)
        return found.poses[np.argsort(found.costs)][:2]

    def _agreement(self, window: Window) -> BoolArray:
        """Marks the last frame's keypoints, in the view's order, that agree with the window."""
        view = self._recent[-1]
        last = window.evidence.sightings.image == len(self._recent) - 1
        order = np.argsort(self._prior.rows_of(view.keypoint_ids, "view.ids"), kind="stable")
        inliers = np.empty(len(order), dtype=bool)
        inliers[order] = self._fits(window)[last]
        return inliers

    def _fits(self, window: Window) -> BoolArray:
        """Marks the sightings of the recent views that agree with the window."""
        options = self._ransac or RansacOptions()
        problem = self._problem(self._recent, range(len(self._recent)))
        limits = thresholds(window.evidence, problem.lenses, problem.threshold(options))
        return whitened_lengths(window.evidence, window.path.state) < limits

    def _again(self, view: View, window: Window) -> Window | None:
        """A window that begins anew where the view's keypoints fit the known shape."""
        if len(view.keypoint_ids) < _LEAST_FOUND:
            return None
        for pose in self._found(view):
            recent, self._recent = self._recent, [view]
            begun = begun_again(window, pose, self._evidence())
            agreement = self._agreement(begun)
            if agreement.mean() >= _AGREE and agreement.sum() >= _LEAST_FOUND:
                self._contradicting, self._is_lost = 0, False
                return begun
            self._recent = recent
        return None

    def _told(self, view: View, inliers: BoolArray, is_new: bool) -> TrackUpdate:
        window = self._window
        assert window is not None
        pose = window.path.state.poses[-1]
        scale = np.exp(window.path.state.log_scales)
        alignment = Alignment(pose[:9].reshape(3, 3), pose[9:], scale)
        covariance = window.newest()[:6, :6]
        at = PoseAt(float(view.time or 0.0), alignment, covariance, window.path.velocities[-1])
        return TrackUpdate(at, inliers, self._is_lost, is_new)
