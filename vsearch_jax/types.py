"""Pytrees that cross a module's border.

Every class here is written for one item. Batch axes come from `jax.vmap` and lead.
Frames: `world` is MuJoCo's world frame (z up); a camera looks along its own -z with +y up.
"""

from __future__ import annotations

import enum
from typing import Any, NamedTuple

import flax.struct
import jax
from jax import Array


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


class Trajectory(NamedTuple):
    """A timed motion along a path with rounded corners; see `vsearch_jax.planning.time_path`. G grid intervals.

    Attributes:
      waypoints: f32[W, nq] rad or m, of the path.
      radii: f32[W] rad, how far before and after each waypoint its bend begins and ends.
      tangents: f32[W - 1, J], unit vectors along the straight pieces, of the joints that move the camera.
      sizes: f32[G] rad, of the intervals along the path.
      times: f32[G + 1] s, at their ends.
      squared_speeds: f32[G + 1] rad^2/s^2, of the path there.
    """

    waypoints: Array
    radii: Array
    tangents: Array
    sizes: Array
    times: Array
    squared_speeds: Array


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
class SACState:
    """Parameters and optimizer states of soft actor-critic.

    Attributes:
      actor: parameters of the policy.
      critic: parameters of the twin Q networks, leading axis 2.
      target_critic: moving average of `critic`, leading axis 2.
      log_alpha: f32[], logarithm of the temperature.
      opt_states: optax states of actor, critic and log_alpha, in this order.
    """

    actor: Any
    critic: Any
    target_critic: Any
    log_alpha: Array
    opt_states: tuple[Any, Any, Any]


@flax.struct.dataclass
class EncoderState:
    """The augmented autoencoder and what turns its raw latent into a code.

    Attributes:
      params: parameters of encoder and decoder (nnx state split to a pytree).
      opt_state: optax state of `params`.
      latent_mean: f32[Z], mean raw latent over the reachable views.
      whitening: f32[Z, Z], symmetric partial whitening matrix of the mean-free raw latent.
    """

    params: Any
    opt_state: Any
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
    env: Any
    replay: Any
    key: jax.Array
    step: Array


@flax.struct.dataclass
class SearchResult:
    """What one search found; G is the most generations (epochs, steps) that the config allows.

    Attributes:
      view: View, the best view seen.
      score: f32[], its score.
      best_scores: f32[G], best score so far after each generation; the last value repeats after the end.
      evaluations: i32[], images taken until the threshold was met, all of them if it was not.
      unreachable: i32[], how many of these the arm could not reach.
      end: what the searcher ended in beyond this: of a policy the brax State, else None.
    """

    view: View
    score: Array
    best_scores: Array
    evaluations: Array
    unreachable: Array
    end: Any = None
