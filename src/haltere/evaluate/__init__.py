"""Several estimators over the same flight, ours and others', and what follows from it. It estimates nothing itself and draws nothing."""

from __future__ import annotations
