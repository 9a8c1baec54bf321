"""Distances of convex solids are at most those of C MuJoCo, and only a little smaller; contacts are never missed."""

import jax
import mujoco
import numpy as np
import pytest

from vsearch_jax.config import SceneConfig
from vsearch_jax.planning.starts import start_limits
from vsearch_jax.robot import build_arm, forward_kinematics, is_free
from vsearch_jax.robot.collision.candidates import Geoms, touching_pairs
from vsearch_jax.robot.collision.convex import Frames, convex_distances
from vsearch_jax.robot.collision.solids import MAX_VERTICES, build_side, convex_solid, hull_vertices
from vsearch_jax.scene import box_corners, build_scene

# m. GJK stops after a fixed number of iterations, and rounding in float32 is subtracted.
TOLERANCE = 3e-4
NUM_POSES = 40


def _model() -> mujoco.MjModel:
    """Returns a model with one geom of each kind, and meshes of 12, 60 and 400 random vertices."""
    spec, random = mujoco.MjSpec(), np.random.default_rng(0)
    shapes = [
        ("sphere", [0.06, 0, 0]),
        ("capsule", [0.03, 0.1, 0]),
        ("cylinder", [0.05, 0.1, 0]),
        ("cylinder", [0.12, 0.01, 0]),
        ("ellipsoid", [0.04, 0.1, 0.06]),
        ("box", [0.05, 0.1, 0.02]),
    ]
    for kind, size in shapes:
        spec.worldbody.add_body().add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), size=size)
    for count in (12, 60, 400):
        vertices = random.normal(size=(count, 3))
        vertices *= 0.1 / np.linalg.norm(vertices, axis=1, keepdims=True)
        vertices[:, 2] *= 1.6
        spec.add_mesh(name=f"mesh{count}", uservert=(vertices + 0.03).reshape(-1))
        spec.worldbody.add_body().add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"mesh{count}")
    for body in spec.bodies[1:]:
        body.add_freejoint()
    return spec.compile()


@pytest.fixture(scope="module")
def poses() -> tuple:
    """Pairs of all kinds, random poses, and the distances of the library and of C MuJoCo, f64[poses, pairs] m."""
    model, random = _model(), np.random.default_rng(1)
    data = mujoco.MjData(model)
    pairs = [(a, b) for a in range(model.ngeom) for b in range(a, model.ngeom)]
    pairs = [(a, b) for a, b in pairs if a != b]
    positions, rotations, theirs = [], [], []
    for pose in range(NUM_POSES):
        spread = 0.35 if pose % 2 else 0.12
        data.qpos.reshape(-1, 7)[:, :3] = random.uniform(-spread, spread, (model.ngeom, 3))
        # Every fifth pose has right angles, where faces and edges are parallel.
        quaternions = random.normal(size=(model.ngeom, 4)) if pose % 5 else random.choice([0.0, 1.0], (model.ngeom, 4))
        quaternions[:, 0] += 1e-9
        data.qpos.reshape(-1, 7)[:, 3:] = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
        mujoco.mj_kinematics(model, data)
        positions.append(data.geom_xpos.copy())
        rotations.append(data.geom_xmat.reshape(-1, 3, 3).copy())
        theirs.append([mujoco.mj_geomDistance(model, data, a, b, 10.0, None) for a, b in pairs])
    positions, rotations = np.array(positions, np.float32), np.array(rotations, np.float32)
    solids = [convex_solid(model, geom) for geom in range(model.ngeom)]

    def frames(geoms: list[int]) -> Frames:
        position, rotation = positions[:, geoms].T, rotations[:, geoms].transpose(2, 3, 1, 0)
        return Frames(tuple(position), tuple(tuple(row) for row in rotation))

    first, second = [a for a, _ in pairs], [b for _, b in pairs]
    sides = build_side([solids[a] for a in first]), build_side([solids[b] for b in second])
    ours = jax.jit(convex_distances)(*sides, (frames(first), frames(second)))
    return np.asarray(ours).T, np.array(theirs)


def test_separated_solids_have_the_distances_of_mujoco(poses):
    ours, theirs = poses
    is_apart = theirs > 1e-4
    assert is_apart.mean() > 0.3
    assert np.all(ours[is_apart] <= theirs[is_apart] + 1e-5)
    assert np.all(ours[is_apart] >= theirs[is_apart] - TOLERANCE)


def test_solids_that_touch_have_no_positive_distance(poses):
    ours, theirs = poses
    assert (theirs < 0.0).mean() > 0.2
    assert np.all(ours[theirs < 0.0] <= 0.0)


def test_a_mesh_with_many_vertices_lies_inside_its_solid():
    random = np.random.default_rng(2)
    vertices = random.normal(size=(MAX_VERTICES + 200, 3))
    vertices *= 0.1 / np.linalg.norm(vertices, axis=1, keepdims=True)
    spec = mujoco.MjSpec()
    spec.add_mesh(name="ball", uservert=vertices.reshape(-1))
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="ball")
    model = spec.compile()
    hull, solid = hull_vertices(model, 0), convex_solid(model, 0)
    assert len(hull) > MAX_VERTICES == len(solid.points)
    assert 0.0 < solid.ball < 1e-3
    directions = random.normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    heights = (solid.points @ directions.T).max(axis=0) + solid.ball
    assert np.all(heights >= (hull @ directions.T).max(axis=0) - 1e-9)
    np.testing.assert_allclose(box_corners(model, 0).max(axis=0), hull.max(axis=0), atol=1e-6)


ARM = """
<mujoco>
  <asset><mesh name="wedge" vertex="-.05 -.05 0 .05 -.05 0 .05 .05 0 -.05 .05 0 0 -.05 .25 0 .05 .25"/></asset>
  <worldbody>
    <body name="base" pos="0 0 0.05">
      <geom type="cylinder" size="0.07 0.05"/>
      <body name="shoulder" pos="0 0 0.06">
        <joint axis="0 0 1" range="-170 170"/>
        <geom name="hub" type="cylinder" size="0.05 0.04" pos="0 0 0.05"/>
        <body name="upper" pos="0 0 0.1">
          <joint axis="0 1 0" range="-130 130"/>
          <geom type="mesh" mesh="wedge" pos="0 0 0.02"/>
          <body name="lower" pos="0 0 0.28">
            <joint axis="0 1 0" range="-160 160"/>
            <geom type="box" size="0.02 0.03 0.12" pos="0 0 0.14"/>
            <body name="hand" pos="0 0 0.28">
              <joint axis="1 0 0" range="-120 120"/>
              <geom type="ellipsoid" size="0.03 0.05 0.06" pos="0 0 0.07"/>
              <site name="tcp" pos="0 0 0.1"/>
              <camera name="wrist" pos="0 0 0.1" quat="0 1 0 0"/>
              <body name="branch" pos="0 0.1 0.05">
                <joint axis="0 1 0" range="-90 90"/>
                <geom name="never" type="capsule" size="0.01 0.03" contype="0" conaffinity="0"/>
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <contact><pair geom1="never" geom2="hub"/></contact>
</mujoco>
"""


def test_an_arm_of_boxes_cylinders_and_meshes_is_free_where_mujoco_finds_no_contact(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    scene = build_scene(SceneConfig(arm=str(path), mount_height=0.8, table_clearance=0.0))
    arm = build_arm(scene)
    lower, upper = start_limits(arm)
    qpos = np.random.default_rng(0).uniform(lower, upper, (400, len(lower))).astype(np.float32)
    ours = jax.jit(lambda arm, qpos: jax.vmap(lambda q: is_free(arm, forward_kinematics(arm, q)))(qpos))(arm, qpos)
    data, theirs = mujoco.MjData(scene.mj_model), []
    for values in qpos:
        data.qpos[:] = values
        mujoco.mj_fwdPosition(scene.mj_model, data)
        theirs.append(data.ncon == 0)
    theirs = np.array(theirs)
    assert 0.2 < theirs.mean() < 0.9
    assert not np.any(np.asarray(ours) & ~theirs)
    assert np.mean(np.asarray(ours) != theirs) <= 0.005


def test_explicit_pairs_are_checked_whatever_the_contact_bits():
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    pairs = touching_pairs(model, data, Geoms(tuple(range(model.ngeom)), (), (), ()), False)
    with_never = [pair for pair in pairs if model.geom("never").id in pair]
    assert [set(pair) for pair in with_never] == [{model.geom("never").id, model.geom("hub").id}]
