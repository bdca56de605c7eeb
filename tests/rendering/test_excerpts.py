from walk import walk

from hdrqn_torchrl.rendering import excerpt


def test_an_excerpt_has_whole_episodes_as_far_as_there_is_room():
    frames = walk("v2", recording={"episodes": 3})  # of four frames each
    assert [len(excerpt(frames, most)) for most in (4, 7, 8, 11, 12, 50)] == [4, 4, 8, 8, 12, 12]
    cut = excerpt(frames, 8)
    assert [(frame.episode, frame.episodes) for frame in cut] == [(1, 2)] * 4 + [(2, 2)] * 4
    assert [frame.scene for frame in cut] == [frame.scene for frame in frames[:8]]


def test_of_a_longer_episode_an_excerpt_has_every_nth_moment_and_the_end():
    frames = walk("v2", recording={"episodes": 3})
    thinned = excerpt(frames, 3)
    assert [frame.score.steps for frame in thinned] == [0, 2, 3] and thinned[-1].outcome
    assert {frame.episodes for frame in thinned} == {1}
    assert [len(excerpt(frames, most)) for most in (1, 2)] == [2, 2]  # a beginning and an end at least


def test_an_excerpt_of_an_episode_without_an_end_is_all_there_is():
    frames = walk("v2")[:2]
    assert [frame.score.steps for frame in excerpt(frames, 4)] == [0, 1]
