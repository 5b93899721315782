from app.settings import load_settings
from app.worker.setup import make_rules


def test_the_steps_of_a_fit_come_from_the_settings(tmp_path) -> None:
    model = tmp_path / "base"
    model.write_bytes(b"weights")
    given = {"model": model, "finetune_steps": 7}
    assert make_rules(load_settings({}, **given), owner="me").steps == 7
    assert make_rules(load_settings({}, model=model), owner="me").steps is None
