"""``python -m bayes_nlsid``."""

from bayes_nlsid.cli import main

raise SystemExit(main())
