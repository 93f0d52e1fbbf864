"""The shape of the repository: who may import whom, what is declared, what ships and what not."""

import ast
import re
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for folder in ("cmrl_jax", "envs")
    for path in sorted((ROOT / folder).rglob("*.py"))
}
# Rooms from the ground up: a module imports from its own and from those before it, wherever in the
# file the import stands. Files that lie directly in `cmrl_jax/` are rooms of their own.
ROOMS = (
    "envs",
    "places",
    "commands",
    "streams",
    "formats",
    "registry",
    "config",
    "stop",
    "parallel",
    "jax_runtime",
    "nn",
    "storage",
    "text",
    "algorithms",
    "evaluation",
    "training",
    "analysis",
    "bench",
    "api",
    "cli",
    "",
    "__main__",
)
# Read and checked before jax is imported.
LIGHT = {
    "commands",
    "places",
    "registry",
    "stop",
    "streams",
    "algorithms.rules",
    *(f"algorithms.{name}.rules" for name in ("cmrl", "maml", "rl2")),
    *(f"config.{name}" for name in ("schema", "rules", "files", "yaml_tree", "extras")),
    *(f"storage.{name}" for name in ("run_dir", "documents", "run_files", "run_groups", "locks")),
    "storage.kept_policies",
    "storage.output_files",
    "analysis.film_options",
    "text.goal_files",
    *(f"evaluation.{name}" for name in ("options", "finetune_options", "cells")),
    *(f"cli.{name}" for name in ("main", "train", "stop_signal", "flags", "goals")),
    *(f"cli.{name}_flags" for name in ("evaluate", "render", "finetune", "plot", "report")),
}
LIGHT_OF_ENVS = {"command_line", "goal_names", "outputs", "tasks"}  # what those take from envs
# Light ones whose commands import the programs they run.
COMMANDS = {"cli.main", "cli.train", "cli.evaluate_flags", "cli.goals"}


def room(name: str) -> int:
    """Place of a module's room in `ROOMS`."""
    package, _, rest = name.partition(".")
    return ROOMS.index("envs" if package == "envs" else rest.partition(".")[0])


def imports(path: Path, top: bool = False) -> Iterator[str]:
    """Dotted names that a file imports, `from a import b` as a.b; with `top`, at import time."""
    nodes: list[ast.AST] = [ast.parse(path.read_text())]
    while nodes:
        node = nodes.pop()
        if top and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        nodes.extend(ast.iter_child_nodes(node))
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            constants = [x.value for x in node.args if isinstance(x, ast.Constant)]
            yield from (value for value in constants if isinstance(value, str))


def own(name: str, top: bool = False) -> set[str]:
    """Modules of ours that a module of ours imports."""
    found = set()
    for imported in imports(MODULES[name], top):
        candidates = (imported, imported.rpartition(".")[0])  # a module, or a name in one
        found |= set([m for m in candidates if m in MODULES][:1])
    return found - {name}


def importers(package: str) -> set[str]:
    """Modules of ours that import a package or one of its parts."""
    return {
        name
        for name, path in MODULES.items()
        if any(f"{i}.".startswith(f"{package}.") for i in imports(path))
    }


def test_the_scan_sees_imports():
    assert "cmrl_jax.config.schema" in own("cmrl_jax.cli.main")
    assert "cmrl_jax.training.trainer" not in own("cmrl_jax.cli.main", top=True)
    assert "yaml" in set(imports(MODULES["cmrl_jax.config.files"]))


def test_envs_know_nothing_of_the_learner():
    for name in MODULES:
        if name.startswith("envs"):
            assert not [i for i in imports(MODULES[name]) if i.startswith("cmrl_jax")], name


@pytest.mark.parametrize("name", sorted(LIGHT))
def test_configuration_imports_nothing_heavy(name):
    allowed = set(sys.stdlib_module_names) | {"yaml", "cmrl_jax", "envs"}
    path = MODULES[f"cmrl_jax.{name}"]
    top = name in COMMANDS
    assert {i.partition(".")[0] for i in imports(path, top)} <= allowed
    light = {f"cmrl_jax.{m}" for m in LIGHT} | {f"envs.{m}" for m in LIGHT_OF_ENVS}
    assert own(f"cmrl_jax.{name}", top) <= light


@pytest.mark.parametrize("name", sorted(LIGHT_OF_ENVS))
def test_what_a_command_line_takes_from_envs_is_light(name):
    found = set(imports(MODULES[f"envs.{name}"]))
    assert {i.partition(".")[0] for i in found} <= set(sys.stdlib_module_names) | {"envs"}
    assert own(f"envs.{name}") <= {f"envs.{m}" for m in LIGHT_OF_ENVS}


def test_imports_point_one_way():
    for name in MODULES:
        upwards = {m for m in own(name) if room(m) > room(name)}
        assert not upwards, f"{name} imports {upwards}"


def test_no_import_cycle():
    """Imports inside functions count: they hide a circle, they do not open it."""
    left = {name: own(name) for name in MODULES}
    while left:
        free = {name for name, needs in left.items() if not needs & set(left)}
        assert free, f"a cycle among {sorted(left)}"
        left = {name: needs for name, needs in left.items() if name not in free}


def test_few_modules_lie_in_no_room():
    assert len(list((ROOT / "cmrl_jax").glob("*.py"))) <= 12


def test_each_library_has_its_room():
    assert importers("orbax") <= {"cmrl_jax.storage.checkpoint"}
    assert importers("flax.linen") <= {
        *(f"cmrl_jax.nn.{name}" for name in ("networks", "layers", "gaussian_policy", "recurrent")),
        "cmrl_jax.text.clip_text",
    }
    assert importers("transformers") == {"cmrl_jax.text.clip_tokenizer", "cmrl_jax.text.minilm"}
    assert importers("huggingface_hub") == {"cmrl_jax.text.clip_weights"}
    assert not importers("torch")
    at_import = {i.partition(".")[0] for m in MODULES.values() for i in imports(m, top=True)}
    assert not at_import & {"transformers", "huggingface_hub", "matplotlib"}


def test_mujoco_is_imported_in_one_place():
    """By `envs.engine`, for which no GL library need be there; metaworld and brax come after it."""
    guard = re.compile(r"\s*(import|from) envs\.(engine|physics\.mjx\.(quiet|backend))\b")
    foreign = re.compile(r"\s*(import|from) (mujoco|metaworld|brax)\b")
    users = importers("mujoco") | importers("metaworld") | importers("brax")
    for name in users - {"envs.engine"}:
        lines = MODULES[name].read_text().splitlines()
        guards = [i for i, line in enumerate(lines) if guard.match(line)]
        late = [i for i, line in enumerate(lines) if foreign.match(line)]
        assert guards and guards[0] < min(late), name


def test_training_and_evaluation_need_no_encoder():
    """Only the commands that turn sentences into vectors reach one."""
    encoder = {"encoders", "minilm", "clip_text", "clip_tokenizer", "clip_weights"}
    encoder = {f"cmrl_jax.text.{name}" for name in encoder}
    assert encoder <= MODULES.keys()
    for name in ("training.trainer", "evaluation.session", "evaluation.evaluator", "bench.main"):
        reached, left = set(), {f"cmrl_jax.{name}"}
        while left:
            reached |= left
            left = {m for at in left for m in own(at, top=True)} - reached
        assert not reached & encoder, name


def test_private_parts_of_libraries_stay_private():
    for name, path in MODULES.items():
        private = {i for i in imports(path) if "._" in i and not i.startswith(("cmrl_jax", "envs"))}
        assert not private, name


def test_what_we_import_is_declared():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    declared = project["dependencies"] + extras["text"] + extras["viz"] + extras["wandb"]
    names = {re.split(r"[\[<>=]", requirement)[0].lower() for requirement in declared}
    as_imported = {
        "yaml": "pyyaml",
        "orbax": "orbax-checkpoint",
        "PIL": "pillow",
        "imageio_ffmpeg": "imageio-ffmpeg",
        "huggingface_hub": "huggingface-hub",
    }
    for name, path in MODULES.items():
        for imported in imports(path):
            root = imported.partition(".")[0]
            if root not in sys.stdlib_module_names and root not in ("cmrl_jax", "envs"):
                assert as_imported.get(root, root).lower() in names, f"{name} imports {root}"
        if any(i.startswith("mujoco.mjx") for i in imports(path)):
            assert "mujoco-mjx" in names


def test_functions_can_be_held_in_the_head():
    files = [*MODULES.values(), *(ROOT / "tests").rglob("*.py"), *(ROOT / "scripts").glob("*.py")]
    for path in [*files, ROOT / "train.py"]:
        text = path.read_text()
        assert len(text.splitlines()) <= 500, path
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                lines = (node.end_lineno or 0) - node.lineno + 1
                assert lines <= 80, f"{path}: {node.name} has {lines} lines"


def test_readme_runs_before_line_30():
    head = (ROOT / "README.md").read_text().splitlines()[:29]
    assert any(line.startswith("make train") for line in head)


def test_lock_holds_names_and_versions_only():
    lines = (ROOT / "requirements.lock").read_text().splitlines()
    locked = {}
    for line in lines:
        match = re.fullmatch(r"([a-z0-9]+(?:-[a-z0-9]+)*)==([0-9][0-9a-z.]*)", line)
        assert match, line
        locked[match[1]] = match[2]
    assert locked["mujoco"] == locked["mujoco-mjx"] == "3.16.0"
    assert locked["metaworld"] == "3.0.0"
    assert not [name for name in locked if re.match(r"torch|nvidia|triton|jax-cuda|warp", name)]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    for requirement in project["dependencies"] + extras["dev"] + extras["text"] + extras["viz"]:
        assert re.split(r"[\[<>=]", requirement)[0].lower() in locked, requirement


def test_wheel_ships_code_data_and_configs_but_no_tests(tmp_path):
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    [wheel] = tmp_path.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    for folder in ("cmrl_jax", "envs"):
        data = (ROOT / folder / "data").rglob("*")
        wanted = {str(p.relative_to(ROOT)) for p in data if p.is_file()}
        wanted |= {str(p.relative_to(ROOT)) for p in (ROOT / folder).rglob("*.py")}
        assert wanted <= names
    assert {f"cmrl_jax/configs/{p.name}" for p in (ROOT / "configs").glob("*.yaml")} <= names
    assert {name.split("/")[0].split("-")[0] for name in names} == {"cmrl_jax", "envs"}


def test_sizes_are_the_environments():
    """No module takes 39 or 4 for granted: sizes are read from the environment at hand."""
    sizes = {"envs.sawyer.OBS_SIZE", "envs.sawyer.ACTION_SIZE"}
    for name, path in MODULES.items():
        assert name.startswith("envs") or not sizes & set(imports(path)), name
        assert not re.search(r"(obs|observation|action)_size\S* = \d", path.read_text()) or (
            name.startswith("envs")
        ), name
