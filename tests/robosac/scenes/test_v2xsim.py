import numpy as np
import pytest

from robosac.boxes import pose_matrix
from robosac.detectors.v2xsim.anchors import anchor_boxes
from robosac.scenes.v2xsim import SampleError, frames, read_sample

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


def test_frames_come_in_order_with_those_present(root):
    read = list(frames(root, 8))
    assert [frame.index for frame in read] == [2, 10]
    assert all(list(frame.samples) == ["agent0", "agent2", "agent5"] for frame in read)


def test_a_scene_that_is_not_there_is_an_error(root):
    with pytest.raises(FileNotFoundError, match="scene 5"):
        next(frames(root, 5))


def test_voxels_are_where_the_network_looks_for_them(root):
    grid = next(frames(root, 8)).samples["agent2"].grid
    assert np.argwhere(grid).tolist() == [[1, 255, 2], [200, 0, 12]]


def test_poses_agree_with_the_transforms(root):
    frame = next(frames(root, 8))
    for k in (2, 5):
        relative = np.linalg.inv(frame.pose("agent2")) @ frame.pose(f"agent{k}")
        np.testing.assert_allclose(relative, frame.samples["agent2"].trans_matrices[k], atol=1e-9)
    with pytest.raises(SampleError, match="no pose of agent1"):
        frame.pose("agent1")


def test_true_boxes_are_decoded_from_their_anchors(root):
    frame = next(frames(root, 8))
    truth = frame.truth("agent0")
    anchors = anchor_boxes(np.ravel_multi_index(PLACES.T, (256, 256, 6)))
    width, length = 2.0 * np.exp(-0.05), 4.0 * np.exp(-0.1)
    x, y = anchors[0, 0] - 0.1 * width, anchors[0, 1] + 0.2 * length
    np.testing.assert_allclose(truth[0], [-x, y, length, width, np.pi / 2], atol=1e-6)
    assert truth[1, 2:4] == pytest.approx([12.0, 3.0 * np.exp(0.1)])
    np.testing.assert_allclose(truth[2, :4], [-anchors[2, 0], anchors[2, 1], 4.0, 2.0], atol=1e-6)
    assert frame.samples["agent0"].category.tolist() == [1, 1, 2]


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
