"""Command lines of ``gvpipe config``."""

import typer

from gvpipe.tools.options import ConfigPath, OutDir, Overrides


def add(app: typer.Typer) -> None:
    """Add the commands."""
    config = typer.Typer(help="Look at a configuration.", no_args_is_help=True)
    app.add_typer(config, name="config")
    config.command("show", epilog="Example: gvpipe config show configs/example.yaml")(config_show)
    config.command("check", epilog="Example: gvpipe config check mine.yaml")(config_check)


def config_show(config: ConfigPath, overrides: Overrides = None, out: OutDir = None) -> None:
    """Print the whole configuration: every key, its value or default, its unit."""
    from gvpipe.configfile import load_config, show_config

    typer.echo(show_config(load_config(config, tuple(overrides or ()), out)), nl=False)


def config_check(config: ConfigPath, overrides: Overrides = None, out: OutDir = None) -> None:
    """Check a configuration, its calibrations and that its pictures are there; list every error."""
    from gvpipe.configcheck import doubts
    from gvpipe.configfile import load_config
    from gvpipe.report import Reporter, log

    Reporter()  # warnings go where those of a run go
    loaded = load_config(config, tuple(overrides or ()), out, inputs=True)
    for doubt in doubts(loaded):
        log.warning("%s", doubt)
    typer.echo(f"{config}: no errors")
