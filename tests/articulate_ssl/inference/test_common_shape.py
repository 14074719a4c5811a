"""The shape that clouds have in common takes their proportions, where faces say how they are turned."""

import torch
from articulated_objects import OVEN, clouds, true_shape
from tiny import POINTS, tiny_module

from articulate_ssl.inference import final_fit
from articulate_ssl.inference.common_shape import CommonShape
from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.training.checkpoint import load_module
from articulate_ssl.training.weights_file import write_weights


def _sorted_shape():
    data = clouds(OVEN, points=200)
    shape = true_shape(OVEN, data)
    order = shape.label.argsort(stable=True)
    return shape, shape.points[order].unflatten(0, (2, 100))


def _learnt_module():
    module = tiny_module(inference=InferenceOptions(proportions=2)).eval()
    module.common_shape.points, module.common_shape.pivot = _sorted_shape()[1], torch.tensor([[0.1, 0.2, 0.3]])
    module.part_frames.flat.fill_(True)
    return module


def test_it_comes_back_as_it_was_set():
    shape, points = _sorted_shape()
    common = CommonShape(2)
    assert not common.learnt
    by_part = shape.label.argsort(stable=True)
    common.set(type(shape)(shape.points[by_part], shape.label[by_part], shape.joints))
    assert common.learnt
    again = common.shape(shape.joints)
    torch.testing.assert_close(again.part(0), points[0])
    torch.testing.assert_close(again.part(1), points[1])
    torch.testing.assert_close(common.pivot, shape.joints.pivot)
    common.forget()
    assert not common.learnt


def test_it_is_kept_in_weights(tmp_path):
    module = _learnt_module()
    module.num_points = POINTS
    write_weights(module, tmp_path / "some.safetensors")
    loaded = load_module(tmp_path / "some.safetensors")
    torch.testing.assert_close(loaded.common_shape.points, module.common_shape.points, atol=5e-4, rtol=0)
    torch.testing.assert_close(loaded.common_shape.pivot, module.common_shape.pivot, atol=5e-4, rtol=0)


def test_weights_from_before_have_none():
    module = _learnt_module()
    state = {name: value for name, value in tiny_module().state_dict().items() if "common_shape" not in name}
    other = tiny_module()
    other.load_state_dict(state)
    assert not other.common_shape.learnt
    # And what was learnt once is replaced by what weights say.
    module.load_state_dict(tiny_module().state_dict())
    assert not module.common_shape.learnt


def test_it_takes_proportions_where_faces_are_known(monkeypatch):
    """And faces are looked at again from there: what they say then is where the last fit starts."""
    module, seen, looks = _learnt_module(), [], []

    def kept(one, category, *_rest):
        seen.append((category.points.shape[0], one.pivot[0, 0].tolist(), float(one.state[0, 0, 0])))
        return one

    def settled(one, dense, afar=False):
        looks.append(len(seen))
        known = torch.ones(len(dense), dtype=torch.bool), torch.ones(len(dense), 1, dtype=torch.bool)
        return one.at(one.base, torch.full_like(one.state, 0.1 * len(looks))), known

    monkeypatch.setattr(final_fit, "fit_proportions", kept)
    monkeypatch.setattr(module.part_frames, "settled", settled)
    monkeypatch.setattr(module.estimator.square_search, "sought", lambda *of: of[:3])  # which settles others, too
    points = torch.randn(1, 4 * POINTS, 3, generator=torch.Generator().manual_seed(0)) / 4
    module.predict_points(points[:, :POINTS], dense=points)
    module.predict_points(points[:, :POINTS])  # without dense clouds there are no faces
    own = module.articulated.category.template.shape[:2].numel()
    assert looks == [0, 1]
    assert [count for count, _, _ in seen] == [200, 200, own]
    for at, state in ((0, 0.1), (1, 0.2)):
        torch.testing.assert_close(seen[at][1:], ([0.1, 0.2, 0.3], state))
    assert seen[2][1] != seen[0][1]
