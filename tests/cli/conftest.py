import pytest

from giril_rl.cli.command_line import main


@pytest.fixture
def refused(capsys):
    """Gives words to ``giril`` that it must refuse; the sentence."""

    def refuse(*argv):
        capsys.readouterr()
        assert main(argv) == 2
        captured = capsys.readouterr()
        (line,) = captured.err.splitlines()
        assert captured.out == ""
        assert line.startswith("giril: ") and line[-1] in ".?"
        return line.removeprefix("giril: ")

    return refuse
