"""Pytrees that cross a module's border.

Every class here is written for one item. Batch axes come from `jax.vmap` and lead.
Frames: `world` is MuJoCo's world frame (z up); a camera looks along its own -z with +y up.
"""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import flax.struct
from jax import Array

if TYPE_CHECKING:  # imports that take seconds, needed for annotations only
    import optax
    from brax.envs.base import State
    from flax import nnx

ParamTree: TypeAlias = "dict[str, ParamTree | Array]"
"""Network parameters as nested dictionaries of arrays."""


class View(NamedTuple):
    """A camera pose on the view sphere: the camera looks at the sphere's centre, image upright.

    Attributes:
      azimuth: f32[] rad, about world z, 0 along world +x.
      elevation: f32[] rad above the table plane.
    """

    azimuth: Array
    elevation: Array


@flax.struct.dataclass
class Camera:
    """A pinhole camera.

    Attributes:
      position: f32[3] m, of the optical centre in world.
      rotation: f32[3, 3], camera to world; columns are the camera's x, y, z axes; it looks along -z.
      fovy: f32[] rad, vertical field of view; not used with intrinsics.
      intrinsics: f32[4] pixels, or None: focal lengths fx and fy and principal point cx and cy, as a calibration gives
        them, with the centre of the first pixel at (0, 0) and y down. They hold for one image size.
    """

    position: Array
    rotation: Array
    fovy: Array
    intrinsics: Array | None = None


@flax.struct.dataclass
class Image:
    """What a camera sees; row 0 is the top of the image.

    Attributes:
      rgb: f32[H, W, 3] in [0, 1].
      depth: f32[H, W] m along the optical axis, +inf on a miss.
      geom_id: i32[H, W], MuJoCo's geom number, -1 on a miss.
      normal: f32[H, W, 3], unit, in world, of the surface as it is lit, towards the camera; 0 on a miss. Pictures
        that are not drawn have none.
    """

    rgb: Array
    depth: Array
    geom_id: Array
    normal: Array | None = None


class IKStatus(enum.IntEnum):
    """How an inverse-kinematics problem ended: solved, no start led there, or pose or joints were NaN or infinite."""

    SOLVED = 0
    UNREACHABLE = 1
    NOT_FINITE = 2


@flax.struct.dataclass
class IKResult:
    """The outcome of one inverse-kinematics problem.

    Attributes:
      qpos: f32[nq] rad or m; inside the joint limits.
      position_error: f32[] m.
      rotation_error: f32[] rad, geodesic; with a free roll, of the optical axis.
      is_converged: bool[], both errors are within the tolerances of the config.
      status: i32[], an IKStatus.
    """

    qpos: Array
    position_error: Array
    rotation_error: Array
    is_converged: Array
    status: Array


class PlanStatus(enum.IntEnum):
    """How a planning problem ended; see `vsearch_jax.planning.rrt_connect`."""

    FOUND = 0
    EXHAUSTED = 1
    START_BLOCKED = 2
    GOAL_BLOCKED = 3


@flax.struct.dataclass
class Path:
    """A joint path of straight pieces.

    Attributes:
      waypoints: f32[W, nq] rad or m, from start to goal; the goal repeats to the end. All are the start without a path.
      length: f32[] rad (or m), sum of the Euclidean lengths in joint space; +inf without a path.
      status: i32[], a PlanStatus.
    """

    waypoints: Array
    length: Array
    status: Array


@flax.struct.dataclass
class ReachabilityMap:
    """Which views of a grid the arm can reach, and with which joints.

    Attributes:
      azimuths: f32[A] rad, periodic and evenly spaced from 0.
      elevations: f32[E] rad, evenly spaced and rising.
      is_reachable: bool[A, E]: IK converges inside the limits without contact.
      qpos: f32[A, E, nq], the best joints found for the view of each cell.
      band: f32[2] rad, lowest and highest elevation of the widest run that is reachable at every azimuth.
    """

    azimuths: Array
    elevations: Array
    is_reachable: Array
    qpos: Array
    band: Array


@flax.struct.dataclass
class Observation:
    """What the wrist camera sees from where the arm stands.

    Attributes:
      view: View that was commanded.
      qpos: f32[nq], joints that hold the camera there.
      camera: Camera, where these joints truly put it: within IK's tolerance of the view.
      code: f32[Z], encoding of the picture.
    """

    view: View
    qpos: Array
    camera: Camera
    code: Array


@flax.struct.dataclass
class EpisodeState:
    """The view-search environment between two steps.

    Attributes:
      observation: Observation of the present view.
      target: Observation of the view that is looked for.
      num_steps: i32[], steps done in the episode.
    """

    observation: Observation
    target: Observation
    num_steps: Array


class Transition(NamedTuple):
    """One step of a view-search episode, as the replay keeps it.

    Attributes:
      obs: f32[265].
      action: f32[2] in [-1, 1].
      reward: f32[].
      next_obs: f32[265], of the state before any reset.
      terminated: f32[], 1 where the episode ended at the threshold: no value follows.
      is_reachable: f32[], 1 where the arm could do the step; 0 where it stayed and `unreachable_reward` was paid.
    """

    obs: Array
    action: Array
    reward: Array
    next_obs: Array
    terminated: Array
    is_reachable: Array


@flax.struct.dataclass
class ReplayState:
    """The newest transitions.

    Attributes:
      data: Transition with a leading axis of the buffer's capacity.
      num_inserted: i32[], transitions inserted so far; the oldest are overwritten.
    """

    data: Transition
    num_inserted: Array


@flax.struct.dataclass
class SACState:
    """Parameters and optimizer states of soft actor-critic.

    Attributes:
      actor: parameters of the policy.
      critic: parameters of the twin Q networks, leading axis 2.
      target_critic: moving average of `critic`, leading axis 2.
      log_alpha: f32[], logarithm of the temperature.
      opt_states: optax states of actor, critic and log_alpha, in this order.
    """

    actor: nnx.State
    critic: nnx.State
    target_critic: nnx.State
    log_alpha: Array
    opt_states: tuple[optax.OptState, optax.OptState, optax.OptState]


@flax.struct.dataclass
class EncoderState:
    """The augmented autoencoder and what turns its raw latent into a code.

    Attributes:
      params: parameters of encoder and decoder (nnx state split to a pytree).
      opt_state: optax state of `params`.
      latent_mean: f32[Z], mean raw latent over the reachable views.
      whitening: f32[Z, Z], symmetric partial whitening matrix of the mean-free raw latent.
    """

    params: ParamTree
    opt_state: optax.OptState
    latent_mean: Array
    whitening: Array


@flax.struct.dataclass
class TrainState:
    """Everything a run needs to go on; S is the number of policy seeds.

    Attributes:
      encoder: EncoderState.
      reach: ReachabilityMap of the arm, mount and object.
      pool: Observation of f32[N, ...]: random reachable views, seen once, from which training episodes start;
        zeros until the encoder is done.
      sac: SACState, leading axis S.
      env: brax State of the training environments, leading axes S, num_envs.
      replay: replay buffer state, leading axis S.
      key: PRNG key from which every later random number of the run is folded.
      step: i32[], iterations done, encoder updates first and policy iterations after them.
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
    """What `SearchResult.end` holds of this searcher.

    Attributes:
      state: brax State at the end of the episode.
      num_helped: i32[], steps that were not the policy's.
      travel: f32[] rad, sum of the steps' metric `joint_travel`.
      duration: f32[] s, sum of `motion_time`.
    """

    state: State
    num_helped: Array
    travel: Array
    duration: Array


@flax.struct.dataclass
class SearchResult:
    """What one search found; G is the most generations (epochs, steps) that the config allows.

    Attributes:
      view: View, the best view seen.
      score: f32[], its score.
      best_scores: f32[G], best score so far after each generation; the last value repeats after the end.
      evaluations: i32[], images taken until the threshold was met, all of them if it was not.
      unreachable: i32[], how many of these the arm could not reach.
      end: PolicyEnd where the searcher is a policy, else None.
    """

    view: View
    score: Array
    best_scores: Array
    evaluations: Array
    unreachable: Array
    end: PolicyEnd | None = None
