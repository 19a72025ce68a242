import shutil

import numpy as np
import pytest

from robosac.boxes import pose_matrix
from robosac.detectors.v2xsim.anchors import anchor_boxes
from robosac.detectors.v2xsim.voxels import occupancy
from robosac.scenes import SOURCES, SceneError
from robosac.scenes.disturbances import Late
from robosac.scenes.v2xsim import SampleError, V2XSim, V2XSimScene, read_sample

POSES = {0: pose_matrix(1.0, 2.0, 0.0, 0.3), 2: pose_matrix(-4.0, 6.0, 0.0, -1.1), 5: pose_matrix(8.0, 0.0, 0.0, 2.0)}
PLACES = np.array([[100, 40, 0], [7, 200, 4], [100, 40, 2]])
CODES = np.array([[0.1, -0.2, 0.05, 0.1, 0.0, 1.0], [0.0, 0.3, -0.1, 0.0, 0.6, 0.8], [0.2, 0.0, 0.0, 0.0, 0.0, 1.0]])


def sample(agent):
    """A sample with three true boxes; the anchor of the last is outside the mask of the loss."""
    allocation = np.zeros((256, 256, 6), dtype=bool)
    allocation[tuple(PLACES.T)] = True
    allocation[3, 3, 3] = True
    loss = allocation.copy()
    loss[tuple(PLACES[2])] = False
    order = np.argsort(np.ravel_multi_index(PLACES.T, allocation.shape))
    transforms = np.zeros((6, 4, 4))
    for other, pose in POSES.items():
        transforms[other] = np.linalg.inv(POSES[agent]) @ pose
    return {
        "voxel_indices_0": np.array([[0, 1, 2], [255, 200, 12]], dtype=np.int32),
        "allocation_mask": allocation,
        "reg_target_sparse": np.concatenate([np.full((1, 6), 9.0), CODES[order]])[:, None].astype(np.float32),
        "reg_loss_mask": loss[..., None],
        "gt_max_iou": np.column_stack([PLACES, [1, 1, 2]]),
        "trans_matrices": transforms,
        "target_agent_id": agent,
    }


@pytest.fixture
def root(tmp_path):
    for agent in range(6):
        for frame in (2, 10):
            folder = tmp_path / f"agent{agent}" / f"8_{frame}"
            folder.mkdir(parents=True)
            np.save(folder / "0.npy", sample(agent) if agent in POSES else 0)
    return tmp_path


@pytest.fixture
def scene(root):
    (scene,) = V2XSim(root).scenes("test")
    return scene


def test_a_scene_has_those_present_in_its_first_frame(scene):
    assert (scene.number, scene.length) == (8, 2)
    assert scene.agents == ("agent2", "agent5", "agent0")
    assert scene.egos == ("agent2", "agent5")
    assert [scene.frame(index).index for index in range(2)] == [0, 1]
    assert all(list(scene.frame(index).views) == ["agent0", "agent2", "agent5"] for index in range(2))


def test_a_late_teammate_sends_the_frame_listed_before(root, scene):
    moved = sample(5) | {"voxel_indices_0": np.array([[9, 9, 9]], dtype=np.int32)}
    np.save(root / "agent5" / "8_10" / "0.npy", moved)
    late = Late(scene, everybody=True)
    for index in range(2):
        sent, before = late.frame(index).views["agent5"], scene.frame(0).views["agent5"]
        np.testing.assert_array_equal(sent.points, before.points)
    assert len(scene.frame(1).views["agent5"].points) == 1


def test_folders_may_be_padded_with_zeros(root):
    for folder in root.glob("agent*/8_2"):
        folder.rename(folder.with_name("08_002"))
    (scene,) = V2XSim(root).scenes("test")
    assert (scene.number, scene.length) == (8, 2)
    assert scene.agents == ("agent2", "agent5", "agent0")
    assert all(list(scene.frame(index).views) == ["agent0", "agent2", "agent5"] for index in range(2))
    (root / "agent2" / "8_2").mkdir()
    with pytest.raises(SceneError, match="08_002 and 8_2 are the same frame"):
        V2XSim(root).scenes("test")


def test_folders_for_each_purpose_are_told_apart(root, tmp_path):
    parts = tmp_path / "parts"
    shutil.copytree(root / "agent2", parts / "test" / "agent2")
    shutil.copytree(root / "agent2" / "8_2", parts / "val" / "agent2" / "9_0")
    source = SOURCES.make(f"v2x-sim:{parts}")
    assert [scene.number for scene in source.scenes("test")] == [8]
    assert [scene.number for scene in source.scenes("validation")] == [9]
    assert source.name.endswith(str(parts))
    assert V2XSim(root).scenes("validation") == V2XSim(root).scenes("test")


@pytest.mark.parametrize(("where", "complaint"), [("", "no folder agent"), ("nonesuch", "is no folder")])
def test_a_folder_without_samples_is_an_error(where, complaint, tmp_path):
    (tmp_path / "agent0").mkdir()
    with pytest.raises(SceneError, match=complaint):
        SOURCES.make(f"v2x-sim:{tmp_path / where}").scenes("test")


def test_points_are_where_the_network_looks_for_voxels(scene):
    for view in scene.frame(0).views.values():
        assert np.argwhere(occupancy(view.points)).tolist() == [[1, 255, 2], [200, 0, 12]]


def test_poses_agree_with_the_transforms(scene):
    views = scene.frame(0).views
    for name, pose in POSES.items():
        lowered = pose @ pose_matrix(0, 0, -5.0 if name == 0 else 0.0, 0)
        relative = np.linalg.inv(views["agent2"].pose) @ views[f"agent{name}"].pose
        np.testing.assert_allclose(relative, np.linalg.inv(POSES[2]) @ lowered, atol=1e-9)


def test_a_present_agent_without_a_pose_is_an_error(root):
    lost = sample(0)
    lost["trans_matrices"][5] = 0
    np.save(root / "agent0" / "8_2" / "0.npy", lost)
    with pytest.raises(SampleError, match="no pose of agent5"):
        V2XSimScene(root, 8).frame(0)


def test_true_boxes_are_decoded_from_their_anchors(scene, root):
    truth = scene.frame(0).truth("agent0")
    anchors = anchor_boxes(np.ravel_multi_index(PLACES.T, (256, 256, 6)))
    width, length = 2.0 * np.exp(-0.05), 4.0 * np.exp(-0.1)
    x, y = anchors[0, 0] - 0.1 * width, anchors[0, 1] + 0.2 * length
    np.testing.assert_allclose(truth[0], [-x, y, length, width, np.pi / 2], atol=1e-6)
    assert truth[1, 2:4] == pytest.approx([12.0, 3.0 * np.exp(0.1)])
    np.testing.assert_allclose(truth[2, :4], [-anchors[2, 0], anchors[2, 1], 4.0, 2.0], atol=1e-6)
    assert read_sample(root / "agent0" / "8_2" / "0.npy").category.tolist() == [1, 1, 2]


def test_a_sample_without_true_boxes_has_none(tmp_path):
    empty = sample(0) | {
        "gt_max_iou": np.zeros((0, 4)),
        "allocation_mask": np.zeros((256, 256, 6), dtype=bool),
        "reg_target_sparse": np.zeros((0, 1, 6)),
    }
    np.save(tmp_path / "0.npy", empty)
    assert read_sample(tmp_path / "0.npy").truth.shape == (0, 5)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"voxel_indices_0": np.array([[0, 256, 0]])}, "voxel_indices_0 must hold whole numbers"),
        ({"voxel_indices_0": np.array([[0, 1, -1]])}, "voxel_indices_0 must hold whole numbers"),
        ({"voxel_indices_0": np.array([[0.5, 1, 1]])}, "voxel_indices_0 must hold whole numbers"),
        ({"voxel_indices_0": [[0, 1, 1]]}, "voxel_indices_0 must be an array"),
        ({"gt_max_iou": np.zeros((2, 3))}, r"gt_max_iou must have the shape \(n, 4\)"),
        ({"trans_matrices": np.full((6, 4, 4), np.inf)}, "NaN or infinity"),
        ({"reg_target_sparse": np.zeros((2, 1, 6))}, r"reg_target_sparse must have the shape \(4, 1, 6\)"),
        ({"trans_matrices": np.array(["x"])}, "array of 'U1'"),
    ],
)
def test_what_is_no_sample_is_explained(change, complaint, tmp_path):
    np.save(tmp_path / "0.npy", sample(0) | change)
    with pytest.raises(SampleError, match=complaint):
        read_sample(tmp_path / "0.npy")


@pytest.mark.parametrize(("content", "complaint"), [({}, "is missing"), (7, "dict"), (np.eye(2), "dict")])
def test_other_files_are_no_samples(content, complaint, tmp_path):
    np.save(tmp_path / "0.npy", content)
    with pytest.raises(SampleError, match=complaint):
        read_sample(tmp_path / "0.npy")
