"""How a report looks: one colour for one thing, for light and dark, and the style sheet. It draws nothing itself."""

from __future__ import annotations

from importlib import resources

__all__ = ["AXES", "COLOURS", "MODES", "OTHERS", "PEERS", "SENSOR_COLOURS", "colours", "style_sheet"]

#: Colour of each thing as (light, dark). Figures name things (``@estimate``, ``@estimate/0.2`` with opacity), never colours.
COLOURS: dict[str, tuple[str, str]] = {
    "estimate": ("#1f6fd0", "#6aabff"),
    "smoothed": ("#8a4630", "#dca08a"),
    "truth": ("#16181c", "#f0f1f3"),
    "onboard": ("#d0700a", "#ffa14a"),
    "gnss": ("#23863a", "#57c873"),
    "barometer": ("#8a3fb0", "#c792ea"),
    "magnetometer": ("#0b8484", "#45c8c8"),
    "imu": ("#4a5a78", "#9fb3d9"),
    "air": ("#0e7490", "#3fc6e0"),
    "assumed": ("#6f757d", "#a4abb5"),
    "refused": ("#cf1f2e", "#ff6b74"),
    "deweighted": ("#7d5f00", "#fff176"),
    "event": ("#a8137a", "#ff85d0"),
    "limit": ("#7d848d", "#8d949e"),
    "good": ("#1d7a34", "#57c873"),
    "doubtful": ("#8c6600", "#f2c43d"),
    "bad": ("#c01c2b", "#ff6b74"),
    "text": ("#1b1f24", "#e4e7eb"),
    "quiet": ("#5b636d", "#a2a9b3"),
    "page": ("#ffffff", "#14171b"),
    "panel": ("#f5f6f8", "#1d2126"),
    "grid": ("#e2e5e9", "#30353c"),
    "axis": ("#aab0b8", "#565d67"),
    "body_x": ("#c2410c", "#ff9466"),
    "body_y": ("#4d7c0f", "#a3d65c"),
    "body_z": ("#4338ca", "#a5a0ff"),
    "mode0": ("#cfa21c", "#c9a227"),
    "mode1": ("#3aa9b8", "#3fb8c8"),
    "mode2": ("#c76ad6", "#c76ad6"),
    "mode3": ("#2fa36b", "#3fb57c"),
    "mode4": ("#e2725b", "#e2725b"),
    "mode5": ("#5b8def", "#5b8def"),
    "mode6": ("#8a7f5c", "#a79b74"),
    "mode7": ("#8f96a3", "#8f96a3"),
    "disarmed": ("#6b7280", "#9aa3b2"),
    "armed": ("#8b5e3c", "#c99b78"),
    "peer0": ("#b5179e", "#f472d0"),
    "peer1": ("#7a2fd0", "#b794ff"),
    "peer2": ("#16805a", "#4fd1a1"),
    "peer3": ("#8a6d00", "#e6c229"),
    "peer4": ("#c2303a", "#ff7b82"),
    "peer5": ("#0e7490", "#3fc6e0"),
    "other0": ("#4d7c0f", "#a3d65c"),
    "other1": ("#5b6474", "#b3bccb"),
    "other2": ("#8b4a4a", "#d9a3a3"),
    "other3": ("#3c3c8c", "#e8e0a0"),
}

#: Number of colours of flight modes.
MODES = 8

#: Number of colours of peers, and of our solutions besides the first.
PEERS, OTHERS = 6, 4

#: Colour of a sensor of the aid records; sensors that are assumptions share one.
SENSOR_COLOURS = {
    "gnss": "gnss",
    "barometer": "barometer",
    "magnetometer": "magnetometer",
    "imu": "imu",
    "accelerometer": "imu",
    "airdata": "air",
    "drag": "air",
    "wind": "air",
}

#: What every axis has.
AXES = {
    "gridcolor": "@grid",
    "zerolinecolor": "@axis",
    "linecolor": "@axis",
    "tickcolor": "@axis",
    "showline": True,
    "ticks": "outside",
    "ticklen": 4,
    "zeroline": False,
}


def colours() -> dict[str, dict[str, str]]:
    """Colours by theme and name, for the browser."""
    return {theme: {name: pair[k] for name, pair in COLOURS.items()} for k, theme in enumerate(("light", "dark"))}


def style_sheet() -> str:
    """The style sheet, with every colour as a variable for either theme; paper is always light."""
    light, dark = ("".join(f"--{name}:{value};" for name, value in theme.items()) for theme in colours().values())
    return (
        f":root{{color-scheme:light dark;{light}}}\n"
        f"@media screen and (prefers-color-scheme:dark){{:root{{{dark}}}}}\n"
        f"{resources.files(__package__).joinpath('page.css').read_text(encoding='utf-8')}"
    )
