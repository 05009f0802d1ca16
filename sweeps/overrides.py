"""Composes the configuration from the words of a command; errors quote these words.

Words are overrides as for `steerbench run` (scene=wires), and `--config-dir=DIR` for a folder with
further choices. Installed packages bring folders of choices, too, named by entry points.
"""

import pkgutil
import re
import shlex
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib import metadata, util
from itertools import pairwise
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString, Sweep
from hydra.core.plugins import Plugins
from hydra.errors import MissingConfigException, OverrideParseException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf, open_dict
from yaml import YAMLError

from bench.errors import SteerbenchError, reason, unexpected, unknown
from bench.kinds import Words

CONFIGS = Path(__file__).parent / "configs"
FLAGS = ("--config-dir", "-cd")

PLACE = re.compile(
    r"[+]*(\w+\.)*(\w+_)?(path|file|dir|folder|root|images|checkpoint|outputs|report|weights)="
    r"|[+]*scene\.(model|split|masks?)="
)
"""Settings whose value names a file or a folder."""

VALIDATION = "validation"
"""The split of held-out training pictures, and the trajectory that renders them."""

PLUG_INS = "steerbench.configs"
"""Group of the entry points; the value of each is the package that holds the YAML files."""


def composed(words: Words, **options: bool) -> DictConfig:
    """The configuration of a run; `options` are those of Hydra's `compose`.

    SteerbenchError if a setting or a choice does not exist, or cannot be read.
    """
    paths = ",".join(quoted(f"file://{folder}") for folder in _typed(words))
    for folder in _typed(words):
        _say_hidden(folder)
    overrides = [*_overrides(words), *([f"hydra.searchpath=[{paths}]"] if paths else [])]
    try:
        with initialize_config_dir(str(CONFIGS), version_base="1.3"):
            return settled(compose("run", overrides=overrides, **options), further(words))
    except Exception as error:
        if not of_hydra(error):
            raise
        raise explain(error, words) from error


def settled(config: DictConfig, folders: Sequence[Path]) -> DictConfig:
    """`config` as a run needs it: without the declaration of a table or a study, which only plans
    read; with the validation trajectory if split=validation asks for it; and with the `folders` of
    further choices, where a method looks for files that its own YAML names.

    From here on only the trajectory determines which pictures are scored, hence held out.
    """
    for group in ("method", "scene", "trajectory", "protocol", "budget", "engine"):
        node = config.get(group)
        if not OmegaConf.is_dict(node) or not isinstance(node.get("_target_"), str):
            expected = "settings with `_target_`, the name of a class or function"
            raise unexpected(f"{group}: its YAML file", expected, "none")
    with open_dict(config):
        for declared in ("table", "study"):
            config.pop(declared, None)
    asked, there = (OmegaConf.select(config, name) for name in ("split", "trajectory.split"))
    if asked == VALIDATION and there != VALIDATION:
        node = OmegaConf.load(CONFIGS / "trajectory" / f"{VALIDATION}.yaml")
        OmegaConf.update(config, "trajectory", node, merge=False, force_add=True)
    if OmegaConf.select(config, "method.folders") is not None:
        OmegaConf.update(config, "method.folders", [str(folder / "method") for folder in folders])
    return config


def variants(words: Words) -> Callable[[Words], DictConfig]:
    """A function that makes the configuration of `words` with further settings.

    Each set of choices is composed once; values are set afterwards as Hydra would, which is faster.
    """
    with_choices = cache(lambda *chosen: composed([*words, *chosen]))

    def varied(settings: Words) -> DictConfig:
        chosen = [x for x in settings if x[0] == "+" or choices(x.partition("=")[0], words)]
        values = [word for word in settings if word not in chosen]
        config = with_choices(*chosen).copy()
        for override in OverridesParser.create().parse_overrides(values):
            OmegaConf.update(config, override.get_key_element(), override.value())
        return config

    return varied


def swept(words: Words) -> dict[str, list[str]]:
    """The values of every setting with several values (seed=0,1,2); the last word for it counts.

    SteerbenchError if a word cannot be read.
    """
    try:
        parsed = OverridesParser.create().parse_overrides(_overrides(words))
    except Exception as error:
        if not of_hydra(error):
            raise
        raise explain(error, words) from error
    last = {override.get_key_element(): override for override in parsed}
    return {
        name: list(override.sweep_string_iterator())
        for name, override in last.items()
        if override.is_discrete_sweep()
    }


def taken(words: Words, name: str) -> tuple[list[str], list[str]]:
    """The words without those that set `name`, and the different values that they give it."""
    named = [word for word in words if word.lstrip("+").partition("=")[0] == name]
    others = [word for word in words if word not in named]
    values = swept(named).get(name)
    if values is None:  # a single one, if any
        values = [word.partition("=")[2] for word in named[-1:]]
    return others, list(dict.fromkeys(values))


def setting(name: str, text: str) -> str:
    """The word that sets `name` to `text`, quoted if Hydra would read something else."""
    plain = _value(text) == text and "${" not in text
    return f"{name}={text if plain else quoted(text)}"


def quoted(text: str) -> str:
    """`text` in quotes as Hydra reads them, also if it looks like an interpolation."""
    return QuotedString(text.replace("${", r"\${"), Quote.single).with_quotes()


def unquoted(text: str) -> str:
    """What `setting` has quoted, or what is typed in quotes inside quotes."""
    return value if isinstance(value := _value(text), str) else text


def as_typed(words: Iterable[str]) -> list[str]:
    """`words` with the names of files and folders in quotes where Hydra would read others.

    Commas separate the values of a sweep, unless a file or folder has a name with them.
    """
    return [_as_typed(*word.split("=", 1)) if PLACE.match(word) else word for word in words]


def _as_typed(name: str, text: str) -> str:
    with suppress(OSError, RuntimeError, ValueError):  # of what can be no name
        if text and Path(text).expanduser().exists():
            return setting(name, text)
    value = _value(text)
    meant = text in ("", "null", "???") or text[0] in "'\"" or "${" in text
    if meant or isinstance(value, Sweep):
        return f"{name}={text}"
    parts = text.split(",") if value is None else [text]
    return f"{name}={','.join(setting('', part)[1:] for part in parts)}"


def _value(text: str) -> Any:
    """What Hydra reads as the value of a setting; None if it cannot."""
    with suppress(Exception):  # its parser raises many kinds
        return OverridesParser.create().parse_override(f"x={text}").value()
    return None


def of_hydra(error: Exception) -> bool:
    """Whether the error comes from Hydra.

    For some mistakes (budget=0.0) Hydra raises a ValueError, or an error of its parser, instead of
    an exception of its own.
    """
    *_, (innermost, _) = traceback.walk_tb(error.__traceback__)
    library = innermost.f_globals["__name__"].partition(".")[0]
    return library in ("hydra", "omegaconf", "antlr4", "yaml") or isinstance(error, UnicodeError)


def explain(error: Exception, words: Words) -> SteerbenchError:
    """Translate an error of Hydra; for unknown names it suggests the nearest existing ones."""
    if isinstance(error, OverrideParseException):
        return SteerbenchError(
            f"cannot read '{error.override}': settings are written key=value, "
            f"for example seed=1 or scene=wires{hint(error.override)} "
            f"({error.message.splitlines()[0]})"
        )
    if several := re.match(r"(?:Ambiguous value for argument|Sweep parameters) '(.*)'", str(error)):
        name, got = several[1].partition("=")[0], f"several{hint(several[1])}"
        return unexpected(name, "one value, or `steerbench run -m`, which measures each", got)
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, name = error.missing_cfg_file.rpartition("/")
        return unknown(group, name, error.options or choices(group, words))
    if key := re.match(r"Could not override '([^']+)'", str(error)):
        if (CONFIGS / key[1]).is_dir():
            return SteerbenchError(
                f"{key[1]}: each method brings its own, and takes no other; choose a method, or a "
                "budget for its sizes"
            )
        return unknown("setting", key[1], _settings(words))
    for word in words:  # a file that cannot be read is named
        group, _, name = word.lstrip("+").partition("=")
        if file := choices(group, words).get(name):
            loaded(file)
    causes = filter(None, (error, error.__cause__))
    lines = [line.strip() for cause in causes for line in str(cause).splitlines()]
    return SteerbenchError("; ".join(filter(None, lines)))


def hint(word: str) -> str:
    """How a shell takes a text as the value of a setting; empty if `word` sets nothing."""
    name, equals, text = word.partition("=")
    word = setting(name, text)
    shown = shlex.quote(word) if set('"$`\\!') & set(word) else f'"{word}"'
    return f"; a text with such signs is written in quotes inside quotes, {shown}" if equals else ""


def _settings(words: Words) -> list[str]:
    """All settings that exist with the choices (scene=blender) in `words`."""
    folders = [CONFIGS, *further(words)]
    groups = {path.name for folder in folders for path in folder.iterdir() if path.is_dir()}
    there = {f"{group}={name}" for group in groups for name in choices(group, words)}
    chosen = [word for word in words if word in there]
    config: Any = composed([*folder_words(words), *chosen])
    return [*groups, *leaves(OmegaConf.to_container(config, resolve=False))]


def leaves(config: Any, prefix: str = "") -> Iterator[str]:
    """The names of all settings in `config`, with dots between the levels."""
    for key, value in config.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{prefix}{key}.")
        elif not key.startswith("_"):
            yield f"{prefix}{key}"


def beside(name: str, words: Words) -> list[str]:
    """The words for the method `name` in place of that of `words`, without settings it lacks."""
    other, missing = composed([*folder_words(words), f"method={name}"]), object()

    def fits(word: str) -> bool:
        setting = word.partition("=")[0].lstrip("+~")
        if "@method" in setting or setting == "method":
            return False
        of_other = not setting.startswith("method.")
        return of_other or OmegaConf.select(other, setting, default=missing) is not missing

    return [*filter(fits, words), f"method={name}"]


def choices(group: str, words: Words = ()) -> dict[str, Path]:
    """The file of every choice of `group` by name, including folders named in `words`; of equal
    names, ours wins, then the first."""
    found = {
        path.stem: path
        for folder in (*reversed(further(words)), CONFIGS)
        for path in (folder / group).glob("*.yaml")
    }
    return dict(sorted(found.items()))


def described(group: str, words: Words = ()) -> dict[str, str]:
    """Every choice of `group`, including folders named in `words`, with its description: the first
    comment that is not a Hydra directive (`# @package`)."""
    comments = {}
    for name, path in choices(group, words).items():
        text = path.read_text(encoding="utf-8", errors="replace")
        lines = [line[1:].strip() for line in text.splitlines() if line[:1] == "#"]
        comments[name] = next((line for line in lines if not line.startswith("@")), "")
    return comments


def loaded(path: Path) -> Any:
    """What a YAML file holds; SteerbenchError if it cannot be read, or holds no settings."""
    try:
        return OmegaConf.to_container(OmegaConf.load(path))
    except (OSError, ValueError, YAMLError) as error:
        raise unexpected(path, "a YAML file of settings", reason(error)) from error


def target_of(node: Mapping[str, Any] | DictConfig) -> Any:
    """The class or function that `_target_` names; SteerbenchError if it cannot be imported."""
    try:
        return pkgutil.resolve_name(node["_target_"])
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        raise SteerbenchError(
            f"cannot import {node['_target_']}: {error}; PYTHONPATH must name the folder of a "
            "package that is not installed"
        ) from error


def engine_kinds(words: Words) -> dict[str, Any]:
    """The class of each engine by name; torch, the standard, comes first."""
    files = sorted(choices("engine", words).items(), key=lambda file: (file[0] != "torch", file))
    return {name: target_of(loaded(path)) for name, path in files}


def folder_words(words: Words) -> list[str]:
    """The folders named in `words`, as words again."""
    return [f"{FLAGS[0]}={folder}" for folder in _typed(words)]


def _overrides(words: Words) -> list[str]:
    return [word for word in as_typed(words) if not word.startswith(f"{FLAGS[0]}=")]


def further(words: Words) -> list[Path]:
    """The folders named in `words`, and those of installed plug-ins."""
    return [*_typed(words), *(x for x in plug_ins().values() if isinstance(x, Path))]


def _typed(words: Words) -> Iterator[Path]:
    """The folders named in `words` by `--config-dir=DIR` or by its form in two words."""
    for word, after in pairwise([*words, ""]):
        name, equals, value = word.partition("=")
        if name in FLAGS:
            yield Path(value if equals else after).resolve()


@cache
def _say_hidden(folder: Path) -> None:
    """Say which choices in a folder are not used, because there are some of these names here."""
    for file in sorted(folder.rglob("*.yaml")):
        if (CONFIGS / file.relative_to(folder)).is_file():
            print(f"{file}: not used: a choice of ours has this name", file=sys.stderr)


@cache
def plug_ins() -> dict[str, Path | str]:
    """The plug-ins of this environment by name, "mine (mine-renderers 1.0)": the folder that holds
    one of YAML files for each group, or why it cannot be used."""
    found = {}
    for entry in sorted(metadata.entry_points(group=PLUG_INS), key=lambda entry: entry.name):
        of = f" ({entry.dist.name} {entry.dist.version})" if entry.dist else ""
        found[entry.name + of] = _folder_of(entry.value)
    return found


def _folder_of(package: str) -> Path | str:
    try:
        spec = util.find_spec(package)  # imports the parent packages
    except Exception as error:  # whatever their code raises
        return f"{type(error).__name__}: {error}"
    if spec is None or not spec.submodule_search_locations:
        return f"there is no package {package}"
    return Path(next(iter(spec.submodule_search_locations)))


class _InstalledChoices(SearchPathPlugin):
    """Appends the plug-ins' folders to Hydra's search path, so that our names take precedence."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for folder in further(()):
            search_path.append("steerbench-plug-in", f"file://{folder}")


Plugins.instance().register(_InstalledChoices)
