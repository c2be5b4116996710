"""The settings of a study of seconds."""

CHANGES = (
    'task={targets=["CylVels_1"], horizons=[1]}',
    'model={backbone={kind="lstm", units=4}, window=5, head={hidden=4}}',
    "training.chunks={length=32, batch=4, burn_in=5}",
    'search={horizon=1, backbones=["lstm"], features=["FG1", "FG2"], updates=2, folds=2, isolation={runs=4}}',
    "search={isolation={seeds=1}, calibration={trials=2}, compression={on=false}}",
    "search.space={units=[2, 4], kernel=false}",
)
