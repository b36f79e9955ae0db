import pytest

from giril_rl.errors import UserError
from giril_rl.files.untrusted import check_format


@pytest.mark.parametrize("found", [0, None, "1", 1.0, True, [1], -1])
def test_a_format_number_of_the_wrong_kind_is_refused(found):
    with pytest.raises(UserError, match=r"reads only 1: convert it\.$"):
        check_format(found, [1], where="a has format", older="convert it")
