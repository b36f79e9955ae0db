import sys
from pathlib import Path

# Test files are imported one by one; this lets them share reward_cases.py and reward_checks.py.
sys.path.insert(0, str(Path(__file__).parent))
