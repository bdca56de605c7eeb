from hdrqn_torchrl.runs.settings.comparing import BOOKKEEPING, NOT_COMPARED, NOT_LEARNED_FROM, flat

SETTINGS = {
    "seed": 1,
    "resume": None,
    "evaluation": {"episodes": 5, "ceilings": False},
    "checkpoint": {"keep_last": 2},
    "logger": {"loggers": []},
    "algo": {"sub": {"tau": 0.1}, "phase_one": {}},
}


def test_every_setting_has_its_full_name_and_empty_sections_are_kept():
    assert flat(SETTINGS) == {
        "seed": 1,
        "resume": None,
        "evaluation.episodes": 5,
        "evaluation.ceilings": False,
        "checkpoint.keep_last": 2,
        "logger.loggers": [],
        "algo.sub.tau": 0.1,
        "algo.phase_one": {},
    }


def test_sections_and_single_settings_are_left_out():
    left = {without: set(flat(SETTINGS, without=without)) for without in (BOOKKEEPING, NOT_LEARNED_FROM, NOT_COMPARED)}
    of_algo = {"algo.sub.tau", "algo.phase_one"}
    assert left == {
        BOOKKEEPING: of_algo | {"seed", "evaluation.episodes", "logger.loggers"},
        NOT_LEARNED_FROM: of_algo | {"seed", "evaluation.episodes"},
        NOT_COMPARED: of_algo,
    }
