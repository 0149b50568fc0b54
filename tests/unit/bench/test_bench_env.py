"""The suite of environments: compression of the transfer and its table."""

from oracle import oracle_btf

from btfref.bench.experiments import env
from btfref.bench.options import Options
from btfref.gates import tolerance


def test_transfer_table_and_plot(need, monkeypatch, coarse_environments):
    need("llvm"), need("gl")
    # Every other of these is taken by the quick run.
    monkeypatch.setattr(env, "CLUSTERS", (2, 8, 16))
    monkeypatch.setattr(env, "COMPONENTS", (8,))
    monkeypatch.setattr(env, "MAP_SIZES", (8,))
    result = env.run(Options(quick=True, btf=oracle_btf((8, 8)), only=("transfer",)))
    rows = result["summary"]["transfer"]
    by_setting = {(r["matrix_clusters"], r["matrix_components"], r["bits"]): r for r in rows}
    assert by_setting[16, 8, 32]["rmse"] < by_setting[2, 8, 32]["rmse"]
    assert all(0 < r["rmse"] < tolerance("bench.transfer.rmse") for r in rows)
    header, lines = env.table(result)
    assert len(lines) == len(rows)
    assert all(len(line) == len(header) for line in lines)


def test_the_plot_of_orders(need, tmp_path):
    need("matplotlib")
    rows = [
        {"environment": "sky", "way": f"order {n}", "window": w, "rmse": 0.1 / n, "low": 0.0, "high": 0.1}
        for n in (2, 3, 4)
        for w in ("none", "hanning")
    ]
    env.plot({"summary": {"order": rows}}, tmp_path / "orders.png")
    assert (tmp_path / "orders.png").read_bytes()[:4] == b"\x89PNG"
