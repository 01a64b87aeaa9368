import pytest

from share.errors import UsageError
from share.lab.emulate.motion.spec import EurocSpec, PaperSpec, RobotSpec, TumSpec, WalkSpec, parse_motion


@pytest.mark.parametrize(
    ("text", "name", "spec"),
    [
        ("walk:", None, WalkSpec()),
        ("ann=walk:speed=1.2,pauses=0", "ann", WalkSpec(speed=1.2, pauses=0)),
        ("r-1=robot:height=0.3", "r-1", RobotSpec(height=0.3)),
        ("euroc:a/b, c,start=5", None, EurocSpec("a/b, c", start=5.0)),
        ("x=tum:/a=b.tum,look=drone,kind=robot", "x", TumSpec("/a=b.tum", kind="robot", look="drone")),
        ("paper:3", None, PaperSpec(3)),
    ],
)
def test_specs_are_read(text, name, spec):
    assert parse_motion(text) == (name, spec)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("wlk:", "did you mean 'walk:'"),
        ("euroc", "did you mean 'euroc:'"),
        ("walk:sped=2", "did you mean 'speed'"),
        ("walk:speed=fast", "expected a number"),
        ("walk:speed=9", "0.2 to 2 m/s"),
        ("walk:3", "'3' is not key=value"),
        ("a b=walk:", "is not a valid name"),
        ("paper:6", "paper:1 to paper:5"),
        ("tum:", "no folder or file"),
        ("tum:x,look=cat", "known: person, robot, drone"),
        ("tum:x,seconds=0", "must be positive"),
        ("robot:speed=nan", "expected a number"),
    ],
)
def test_an_error_names_the_wrong_part(text, says):
    with pytest.raises(UsageError) as caught:
        parse_motion(text)
    assert says in str(caught.value) and "\n" not in str(caught.value)
