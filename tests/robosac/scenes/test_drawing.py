from matplotlib.image import imread

from robosac.scenes.drawing import draw_view


def test_draws_every_true_box_once(scene_frame, tmp_path):
    seen, hidden = draw_view(scene_frame, "car-1", tmp_path / "deep" / "view.png")
    assert seen + hidden == len(scene_frame.truth("car-1"))
    assert hidden > 0
    picture = imread(tmp_path / "deep" / "view.png")
    assert picture.shape[0] > 500
    assert picture.std() > 0.01
