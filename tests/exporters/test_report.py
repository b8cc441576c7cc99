"""The energy ledger in ``report.json`` equals the clip's, and it balances."""

import json

import numpy as np
import pytest

import vehsim
from vehsim import State, Take, World
from vehsim.exporters.tables.report import write_report


def test_the_report_has_each_vehicles_energy_ledger(tmp_path):
    car = vehsim.load_vehicle("car")
    clip = vehsim.simulate(car, World(), (400.0, 0.1), State(twist=(0, 5.0, 0)), duration=1.0)
    take = Take("coast", {"car": clip}, World(), (), clip.fps, (clip.start_frame, clip.end_frame))
    report = json.loads(write_report(take, tmp_path, []).read_text())
    ledger = report["vehicles"]["car"]["energy_J"]
    assert ledger.keys() == {"kinetic", "potential", "work", "dissipated", "imbalance"}
    for name, values in clip.energy.items():
        expected = {"first": values[0], "last": values[-1], "least": values.min(), "most": values.max()}
        assert ledger[name] == pytest.approx(expected)
    gained = ledger["kinetic"]["last"] - ledger["kinetic"]["first"]
    assert gained == pytest.approx(ledger["work"]["last"] - ledger["dissipated"]["last"], rel=1e-3) and gained > 100
    assert max(np.abs([ledger["imbalance"]["least"], ledger["imbalance"]["most"]])) < 1e-3 * gained
