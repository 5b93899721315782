from pathlib import Path

import pytest
from pydantic import ValidationError

from app.settings import BadSettingsError, Settings, list_settings, load_settings


def test_defaults_serve_on_this_machine_only():
    settings = load_settings({})
    assert (settings.host, settings.port, settings.data_dir) == ("127.0.0.1", 8000, Path("var"))


def test_environment_sets_and_arguments_win(monkeypatch):
    monkeypatch.setenv("KINECAST_PORT", "9000")
    monkeypatch.setenv("KINECAST_MAX_RATE_HZ", "60")
    settings = load_settings(port=9001, host=None)
    assert (settings.port, settings.max_rate_hz, settings.host) == (9001, 60.0, "127.0.0.1")


@pytest.mark.parametrize(
    ("variable", "hint"),
    [
        ("KINECAST_PROT", "Did you mean KINECAST_PORT?"),
        ("KINECAST_STREAM_PER_KEY", "Did you mean KINECAST_STREAMS_PER_KEY?"),
        ("KINECAST_XYZZY_Q", "Unknown setting KINECAST_XYZZY_Q."),
    ],
)
def test_unknown_variable_is_refused_with_a_hint(variable, hint):
    with pytest.raises(BadSettingsError) as caught:
        load_settings({variable: "1"})
    assert str(caught.value).endswith(hint)


def test_variables_of_the_test_suite_and_of_others_are_left_alone():
    load_settings({"KINECAST_TEST_DATABASE_URL": "x", "PATH": "/bin"})


def test_wrong_value_is_named_but_not_shown(monkeypatch):
    monkeypatch.setenv("KINECAST_ENGINE_BATCH", "secret-value")
    with pytest.raises(BadSettingsError) as caught:
        load_settings()
    assert "KINECAST_ENGINE_BATCH" in str(caught.value)
    assert "secret-value" not in str(caught.value)


def test_secrets_come_from_files(tmp_path):
    (tmp_path / "kinecast_admin_key").write_text("k" * 40 + "\n")
    settings = load_settings({"KINECAST_SECRETS_DIR": str(tmp_path)})
    assert settings.admin_key is not None
    assert settings.admin_key.get_secret_value() == "k" * 40
    assert "k" * 40 not in repr(settings)


def test_missing_folder_of_secrets_is_an_error(tmp_path):
    with pytest.raises(BadSettingsError, match="there is no folder"):
        load_settings({"KINECAST_SECRETS_DIR": str(tmp_path / "none")})


def test_history_is_kept_for_a_day_at_least(monkeypatch):
    monkeypatch.setenv("KINECAST_HISTORY_KEPT_DAYS", "0.5")
    with pytest.raises(BadSettingsError, match=r"KINECAST_HISTORY_KEPT_DAYS.*equal to 1"):
        load_settings()
    assert load_settings(history_kept_days=1).history_kept_days == 1


def test_settings_cannot_be_changed():
    settings = load_settings({})
    with pytest.raises(ValidationError):
        settings.port = 1


def test_every_setting_is_described():
    for setting in list_settings():
        assert setting.sentence.endswith("."), setting
    assert len(list_settings()) == len(Settings.model_fields)
