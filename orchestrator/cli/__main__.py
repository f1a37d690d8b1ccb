"""`python -m panolog.orchestrator.cli`: the program, as the supervisor starts its drivers.

It is separate because Python looks for it here.
"""

from panolog.orchestrator.cli.app import main

main()
