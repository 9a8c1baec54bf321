"""Pytrees that several rooms share.

Every class is written for one item. Batch axes come from `jax.vmap` and lead.
Frames: `world` is MuJoCo's world frame, z up. A camera looks along its own -z axis, with +y up.
An `Observation` is what the wrist camera sees from one pose of the arm. An `obs` is the policy's flat input vector.
"""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import flax.struct
from jax import Array

if TYPE_CHECKING:  # These imports take seconds, and only annotations need them.
    import optax
    from brax.envs.base import State
    from flax import nnx

ParamTree: TypeAlias = "dict[str, ParamTree | Array]"  # network parameters


class View(NamedTuple):
    """A camera position on the view sphere around the object. The camera looks at the sphere's centre, image upright.

    Attributes:
      azimuth: f32[] rad, about world z; 0 along world +x.
      elevation: f32[] rad above the table plane.
    """

    azimuth: Array
    elevation: Array


@flax.struct.dataclass
class Camera:
    """A pinhole camera.

    Attributes:
      position: f32[3] m, optical centre in world.
      rotation: f32[3, 3], camera to world. Columns are the camera's x, y, z axes. The camera looks along -z.
      fovy: f32[] rad, vertical field of view; not used with intrinsics.
      intrinsics: f32[4] pixels, or None: fx, fy, cx, cy for one image size; first pixel's centre is (0, 0), y down.
    """

    position: Array
    rotation: Array
    fovy: Array
    intrinsics: Array | None = None


@flax.struct.dataclass
class Image:
    """A rendered image of H x W pixels; row 0 is the top.

    Attributes:
      rgb: f32[H, W, 3] in [0, 1].
      depth: f32[H, W] m along the optical axis; +inf on a miss.
      geom_id: i32[H, W], MuJoCo's geom number; -1 on a miss.
      normal: f32[H, W, 3], unit normal in world, towards the camera; 0 on a miss. None if the image is not rendered.
    """

    rgb: Array
    depth: Array
    geom_id: Array
    normal: Array | None = None


class IKStatus(enum.IntEnum):
    """Result of an inverse-kinematics problem."""

    SOLVED = 0
    UNREACHABLE = 1  # no start converged
    NOT_FINITE = 2  # the pose or the joint values were NaN or infinite


@flax.struct.dataclass
class IKResult:
    """The solution of one inverse-kinematics problem.

    Attributes:
      qpos: f32[nq] rad or m, joint values inside the joint limits.
      position_error: f32[] m, distance of the camera from the wanted position.
      rotation_error: f32[] rad, geodesic; with a free roll, the angle between the optical axes.
      is_converged: bool[], both errors are within the tolerances of the config.
      status: i32[], an IKStatus.
    """

    qpos: Array
    position_error: Array
    rotation_error: Array
    is_converged: Array
    status: Array


class PlanStatus(enum.IntEnum):
    """Result of a path-planning problem; see `vsearch_jax.planning.rrt_connect`."""

    FOUND = 0
    EXHAUSTED = 1
    START_BLOCKED = 2
    GOAL_BLOCKED = 3


@flax.struct.dataclass
class Path:
    """A path in joint space of W waypoints, joined by straight pieces.

    Attributes:
      waypoints: f32[W, nq] rad or m, from start to goal, which fills the last rows. Without a path: only the start.
      length: f32[] rad (or m), sum of the Euclidean lengths in joint space; +inf without a path.
      status: i32[], a PlanStatus.
    """

    waypoints: Array
    length: Array
    status: Array


@flax.struct.dataclass
class ReachabilityMap:
    """The views of a grid of A azimuths and E elevations that the arm can reach, with joint values for each (a cell).

    Attributes:
      azimuths: f32[A] rad, periodic, evenly spaced from 0.
      elevations: f32[E] rad, evenly spaced, rising.
      is_reachable: bool[A, E], IK converges inside the joint limits and without contact.
      qpos: f32[A, E, nq] rad or m, the best joint values found for the view of each cell.
      band: f32[2] rad, limits of the widest range of elevations reachable at every azimuth; NaN if there is none.
    """

    azimuths: Array
    elevations: Array
    is_reachable: Array
    qpos: Array
    band: Array


@flax.struct.dataclass
class Observation:
    """What the wrist camera sees from one configuration of the arm. A code has Z numbers.

    Attributes:
      view: the commanded View.
      qpos: f32[nq] rad or m, joint values of the arm.
      camera: the Camera that `qpos` gives; it is within IK's tolerance of `view`.
      code: f32[Z], code of the camera's image.
    """

    view: View
    qpos: Array
    camera: Camera
    code: Array


@flax.struct.dataclass
class EpisodeState:
    """State of a view-search episode between two steps.

    Attributes:
      observation: Observation from the present view.
      target: Observation from the target view, which the episode searches for.
      num_steps: i32[], number of steps done in the episode.
    """

    observation: Observation
    target: Observation
    num_steps: Array


class Transition(NamedTuple):
    """One step of a view-search episode. D is the size of `obs`, 265 for the LWR.

    Attributes:
      obs: f32[D], policy input before the step.
      action: f32[2] in [-1, 1], change of azimuth and elevation in units of `action_scale_deg`.
      reward: f32[].
      next_obs: f32[D], policy input after the step and before any reset.
      terminated: f32[], 1 if the similarity to the target met the threshold. No reward follows such a step.
      is_reachable: f32[], 1 if the arm did the step; 0 if it stayed, and the reward is `unreachable_reward`.
    """

    obs: Array
    action: Array
    reward: Array
    next_obs: Array
    terminated: Array
    is_reachable: Array


@flax.struct.dataclass
class ReplayState:
    """The replay buffer: a ring of the newest transitions.

    Attributes:
      data: Transition with a leading axis of the buffer's capacity.
      num_inserted: i32[], number of transitions inserted so far. New transitions overwrite the oldest.
    """

    data: Transition
    num_inserted: Array


@flax.struct.dataclass
class SACState:
    """Parameters and optimizer states of soft actor-critic.

    Attributes:
      actor: parameters of the policy.
      critic: parameters of the twin Q networks, leading axis 2.
      target_critic: moving average of `critic`, leading axis 2; or of `value` if there is one.
      log_alpha: f32[], logarithm of the temperature.
      value: parameters of the state value network; None without one.
      opt_states: optax states of actor, critic and third: `value` if there is one, else log_alpha.
    """

    actor: nnx.State
    critic: nnx.State
    target_critic: nnx.State
    log_alpha: Array
    value: nnx.State | None
    opt_states: tuple[optax.OptState, optax.OptState, optax.OptState]


@flax.struct.dataclass
class EncoderState:
    """The augmented autoencoder, and the mean and whitening that turn its raw latent of Z numbers into a code.

    Attributes:
      params: parameters of encoder and decoder.
      opt_state: optax state of `params`.
      latent_mean: f32[Z], mean raw latent over the reachable views.
      whitening: f32[Z, Z], symmetric partial whitening matrix of the centred raw latent.
    """

    params: ParamTree
    opt_state: optax.OptState
    latent_mean: Array
    whitening: Array


@flax.struct.dataclass
class TrainState:
    """Complete state of a run; S policies are trained, one for each policy seed.

    Attributes:
      encoder: EncoderState.
      reach: ReachabilityMap of the arm, mount and object.
      pool: Observation, leading axis N: N random views where training episodes start; zeros until the encoder is done.
      sac: SACState, leading axis S.
      env: brax State of the training environments, leading axes S, num_envs.
      replay: ReplayState, leading axis S.
      key: PRNG key. Every later random number of the run comes from it by `fold_in`.
      step: i32[], number of iterations done: encoder updates first, then policy iterations.
    """

    encoder: EncoderState
    reach: ReachabilityMap
    pool: Observation
    sac: SACState
    env: State
    replay: ReplayState
    key: Array
    step: Array


class PolicyEnd(NamedTuple):
    """End of a search by a policy; the value of `SearchResult.end`.

    Attributes:
      state: brax State at the end of the episode.
      travel: f32[] rad, length of the arm's path in joint space, summed over the steps.
      duration: f32[] s, time of the arm's motions, summed over the steps.
    """

    state: State
    travel: Array
    duration: Array


@flax.struct.dataclass
class SearchResult:
    """Result of one search; G is the largest number of generations (or steps) that the config allows.

    Attributes:
      view: the View with the best score.
      score: f32[], score of `view`: its similarity to the target.
      best_scores: f32[G], best score after each generation. After the end of the search the last value repeats.
      evaluations: i32[], number of images until the threshold was met; the number of all images if it was not met.
      unreachable: i32[], number of these images' views that the arm could not reach.
      end: PolicyEnd if the searcher is a policy, otherwise None.
    """

    view: View
    score: Array
    best_scores: Array
    evaluations: Array
    unreachable: Array
    end: PolicyEnd | None = None
