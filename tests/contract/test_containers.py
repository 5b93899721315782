"""The image and the composition say what settings and commands say. Nothing is built here."""

import ast
import re
import shutil
import subprocess
import tomllib
from fnmatch import fnmatch

import pytest
import yaml
from dockerfile_parse import DockerfileParser
from typer.main import get_command

from app.cli import app
from app.settings import list_settings
from tests.conftest import ROOT

COMPOSE = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
SERVICES = COMPOSE["services"]
OURS = {name: one for name, one in SERVICES.items() if "build" in one}
SETTINGS = {setting.variable for setting in list_settings()}
SECRETS = {"POSTGRES_PASSWORD", "KINECAST_ADMIN_KEY", "KINECAST_AUDIT_KEY"}


def read_dockerfile():
    """Its instructions by stage: a list of (instruction, value) for each."""
    parser = DockerfileParser(path=str(ROOT / "Dockerfile"), cache_content=True)
    stages = []
    for line in parser.structure:
        if line["instruction"] == "FROM":
            stages.append([])
        if line["instruction"] != "COMMENT":
            stages[-1].append((line["instruction"], line["value"]))
    return stages


def values(stage, instruction):
    return [value for name, value in stage if name == instruction]


BUILD, FINAL = read_dockerfile()


def read_environment():
    """The variables that the image sets."""
    return dict(re.findall(r"(\w+)=(\S+)", values(FINAL, "ENV")[0]))


def check_command(arguments):
    """Fail unless these are a command of kinecast and options that it has."""
    commands = get_command(app).commands
    name, *rest = arguments
    assert name in commands, name
    command = commands[name]
    if hasattr(command, "commands"):
        assert rest[0] in command.commands, arguments
        command, rest = command.commands[rest[0]], rest[1:]
    options = {option for one in command.params for option in (*one.opts, *one.secondary_opts)}
    assert set(rest) <= options, arguments


def test_the_image_runs_as_nobody_in_particular():
    user = values(FINAL, "USER")
    assert user == ["10001:10001"]
    instructions = [name for name, _ in FINAL]
    assert "RUN" not in instructions[instructions.index("USER") :]


@pytest.mark.parametrize("instruction", ["ENTRYPOINT", "CMD"])
def test_signals_reach_kinecast_because_no_shell_is_between(instruction):
    (value,) = values(FINAL, instruction)
    assert isinstance(ast.literal_eval(value), list)


def test_the_image_starts_a_command_that_exists():
    assert ast.literal_eval(values(FINAL, "ENTRYPOINT")[0]) == ["kinecast"]
    check_command(ast.literal_eval(values(FINAL, "CMD")[0]))
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert "kinecast" in scripts


def test_the_image_has_the_torch_and_the_python_of_everywhere_else():
    arguments = dict(value.split("=", 1) for value in values(BUILD, "ARG"))
    makefile = (ROOT / "Makefile").read_text()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pin = f"torch=={arguments['TORCH_VERSION']}"
    assert f"TORCH := {pin}\n" in makefile
    assert pin in project["dependencies"]
    assert f"TORCH_INDEX ?= {arguments['TORCH_INDEX']}\n" in makefile
    python = {values(stage, "FROM")[0].split()[0] for stage in (BUILD, FINAL)}
    version = project["requires-python"].removeprefix(">=")
    assert python == {f"python:{version}", f"python:{version}-slim"}
    assert any("--constraint .constraints.txt ." in run for run in values(BUILD, "RUN"))


def is_sent(path):
    """Whether .dockerignore lets a path get as far as the build; the last rule that fits wins."""
    sent = True
    for rule in (ROOT / ".dockerignore").read_text().splitlines():
        if not rule or rule.startswith("#"):
            continue
        pattern = rule.removeprefix("!").removeprefix("**/")
        parts = [path, path.split("/")[0], path.rsplit("/", 1)[-1]]
        if any(fnmatch(part, pattern) for part in parts):
            sent = rule.startswith("!")
    return sent


def test_everything_that_is_copied_exists_and_is_sent_to_the_build():
    copied = [value.split() for value in values(BUILD, "COPY")]
    sources = [source for *some, _ in copied for source in some]
    assert "app" in sources
    for source in sources:
        assert (ROOT / source).exists(), source
        assert is_sent(source), source


@pytest.mark.parametrize(
    "path",
    ["var/kinecast.sqlite3", ".env", "shared/data/a1_s1_t1.mat", ".git/config", "tests/x.py"],
)
def test_recordings_databases_and_secrets_are_not_sent_to_the_build(path):
    assert not is_sent(path)


def test_the_health_check_asks_whether_it_can_forecast_at_the_port_that_it_has():
    environment = read_environment()
    (check,) = values(FINAL, "HEALTHCHECK")
    command = ast.literal_eval(check.split("CMD ", 1)[1])
    assert command[0] == "python"
    asked = []
    fake = "class Fake:\n    urlopen = staticmethod(lambda url, timeout: asked.append(url))\n"
    code = command[2].replace("import os, urllib.request as u;", "import os; u = Fake;")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("KINECAST_PORT", "9000")
        exec(fake, scope := {"asked": asked})  # noqa: S102 - the image's own command
        exec(code, scope)  # noqa: S102
    assert asked == ["http://127.0.0.1:9000/readyz"]
    assert values(FINAL, "EXPOSE") == [environment["KINECAST_PORT"]]
    assert values(FINAL, "VOLUME") == [environment["KINECAST_DATA_DIR"]]


def test_the_linter_of_dockerfiles_has_nothing_to_say():
    hadolint = shutil.which("hadolint", path=str(ROOT / ".venv/bin")) or shutil.which("hadolint")
    if hadolint is None:
        pytest.skip("no hadolint on this machine")
    done = subprocess.run(
        [hadolint, "--no-color", "Dockerfile"], cwd=ROOT, check=False, capture_output=True
    )
    assert done.returncode == 0, done.stdout.decode()


def test_every_variable_of_image_and_composition_is_a_setting():
    named = set(read_environment())
    for service in OURS.values():
        named |= set(service["environment"])
    ours = {name for name in named if name.startswith("KINECAST_")}
    assert ours == SETTINGS - {"KINECAST_MODEL"}  # a path, of a file that would have to be mounted


def test_every_service_of_ours_runs_a_command_that_exists():
    assert set(OURS) == {"migrate", "api", "worker"}
    for service in OURS.values():
        check_command(service["command"])


def test_services_wait_for_what_they_need_and_for_no_more():
    for service in SERVICES.values():
        for name, needs in service.get("depends_on", {}).items():
            other = SERVICES[name]
            if needs["condition"] == "service_healthy":
                assert "test" in other["healthcheck"], name
            if needs["condition"] == "service_completed_successfully":
                assert other["restart"] == "no", name
    for name in ("api", "worker"):
        waits = SERVICES[name]["depends_on"]
        assert waits["migrate"]["condition"] == "service_completed_successfully"
        assert waits["redis"]["condition"] == "service_started"  # a hint: nobody waits for it


def test_what_scales_has_no_name_and_no_port_of_its_own():
    for name in ("api", "worker"):
        service = SERVICES[name]
        assert "container_name" not in service
        for port in service.get("ports", ()):
            host, _, inside = port.rpartition(":")
            assert "-" in host, "replicas would fight for one port"
            assert host.startswith("127.0.0.1:")
            assert inside == read_environment()["KINECAST_PORT"]


def test_addresses_name_services_that_exist():
    for service in OURS.values():
        for address in ("KINECAST_DATABASE_URL", "KINECAST_REDIS_URL"):
            host = re.search(r"(?:@|//)(\w+):\d+/\w+$", service["environment"][address])
            assert host, address
            assert host[1] in SERVICES


def test_no_secret_has_a_value_or_a_default_in_the_file():
    text = (ROOT / "docker-compose.yml").read_text()
    used = re.findall(r"\$\{(\w+)(:\?|:-|)", text)
    assert {name for name, how in used if how == ":?"} == SECRETS
    assert not {name for name, how in used if how != ":?"} & SECRETS
    named = set(re.findall(r"`(\w+)`", (ROOT / "docs" / "operations.md").read_text()))
    assert named >= SECRETS


def test_volumes_are_declared():
    used = {
        one.split(":")[0] for service in SERVICES.values() for one in service.get("volumes", ())
    }
    assert used == set(COMPOSE["volumes"])


def test_it_may_take_as_long_to_leave_as_the_settings_say():
    drain_s = next(
        float(one.default) for one in list_settings() if one.variable.endswith("_DRAIN_S")
    )
    for name in ("api", "worker"):
        assert int(SERVICES[name]["stop_grace_period"].removesuffix("s")) > 2 * drain_s
