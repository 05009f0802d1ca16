"""`steerbench check`: are the figures as good as they were, when a baseline was recorded; and
`steerbench compare`: what changed from one run of the store to another."""

import argparse
import json
import os
import xml.etree.ElementTree as ET
from dataclasses import asdict
from itertools import chain
from pathlib import Path

from bench.errors import SteerbenchError, explained
from bench.results import existing_store
from reports.regression import Figures, change_table, changes
from reports.runs import load_runs
from reports.tables import decimal
from sweeps.baseline import Checks, checked, record
from sweeps.terminal import finite, say, show


def main(options: argparse.Namespace) -> int:
    """Compare the store with a baseline, or write one; 1 if anything is worse or missing."""
    if options.command == "compare":
        return _compare(options)
    forms = {"markdown": _markdown, "junit": _junit, "json": _json}
    if unused := [x for x in (forms if options.record else ["limit"]) if getattr(options, x)]:
        used = "without" if options.record else "with"
        raise SteerbenchError(f"--{unused[0]}: expected {used} --record")
    if options.record:
        record(options.baseline, options.outputs, options.limit, say)
        return 0
    found = checked(options.baseline, options.outputs, say)
    for name, form in forms.items():
        if path := getattr(options, name):
            _write(path, form(found))
    if options.json != Path("-"):
        for run in found:
            show(change_table(run[0].run, run))
            say(run[0].note)
        say(_verdict(found))
    return int(any(each.verdict for each in chain(*found)))


def _compare(options: argparse.Namespace) -> int:
    store = existing_store(options.outputs)
    keys = [store.whole_key(key) for key in (options.old, options.new)]
    old, new = load_runs(store, keys)
    rows = list(changes([Figures.of(old)], [Figures.of(new)]))
    show(change_table(" to ".join(keys), rows))
    say(f"PSNR between the pictures that both kept: {decimal(old.psnr_to(new), 2)} dB")
    return int(any(row.verdict for row in rows))


def _verdict(found: Checks) -> str:
    """One line: what is worse, by how much, against which limit, what is missing; how many figures
    were compared, and what else to know."""
    rows = list(chain(*found))
    compared = sum(each.verdict != "missing" for each in rows)
    notes = dict.fromkeys(run[0].note for run in found if run[0].note)
    parts = [
        f"{verdict}: {', '.join(said)}: {run[0].run}"
        for run in found
        for verdict in ("worse", "missing")
        if (said := [str(each) for each in run if each.verdict == verdict])
    ]
    told = f"{compared} of {len(rows)} figures of {len(found)} runs compared"
    return "; ".join((*(parts or ["as good as the baseline"]), told, *notes))


def _markdown(found: Checks) -> str:
    parts = ["## steerbench check", _verdict(found)]
    for run in found:
        parts += [f"### {run[0].run}", change_table("", run).markdown(), run[0].note]
    return "\n\n".join(filter(None, parts)) + "\n"


def _junit(found: Checks) -> str:
    suite = ET.Element("testsuite", name="steerbench check")
    for each in chain(*found):
        case = ET.SubElement(suite, "testcase", classname=each.run, name=each.metric)
        if each.verdict:
            ET.SubElement(case, "failure", message=f"{each.verdict}: {each}").text = each.note
    failures = str(len(suite.findall("*/failure")))
    suite.attrib |= {"tests": str(len(suite)), "failures": failures}
    return ET.tostring(suite, encoding="unicode", xml_declaration=True) + "\n"


def _json(found: Checks) -> str:
    return json.dumps(finite([asdict(each) for each in chain(*found)]), indent=1) + "\n"


def _write(path: Path, text: str) -> None:
    if path == Path("-"):
        print(text, end="")
        return
    adds = str(path) == os.environ.get("GITHUB_STEP_SUMMARY")  # other steps write there, too
    with explained(path.parent), path.open("a" if adds else "w", encoding="utf-8") as file:
        file.write(text)
