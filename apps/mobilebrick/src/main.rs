//! The `mobilebrick` command: arguments, progress bars and exit status; the work is done in the crates below.
//!
//! Exit status: 0 done, 1 failed, 2 wrong usage, 3 bad input. With `--json` exactly one JSON document goes to stdout,
//! also on failure; logs and progress go to stderr.

mod commands;
mod memory;
mod outcome;
mod terminal;

use std::process::ExitCode;

use clap::Parser;

use crate::commands::Command;
use crate::outcome::Failure;
use crate::terminal::Terminal;

/// A brick model and a phone capture are aligned, turned into exact ground truth, reconstructed by methods, and scored.
#[derive(Debug, Parser)]
#[command(name = "mobilebrick", version, max_term_width = 100, arg_required_else_help = true)]
struct Arguments {
    #[command(subcommand)]
    command: Command,

    #[command(flatten)]
    global: Global,
}

/// Options of every subcommand.
#[derive(Debug, clap::Args)]
struct Global {
    /// Print exactly one JSON document on stdout
    #[arg(long, global = true)]
    json: bool,

    /// Worker threads; the default is one per core. Results do not depend on it
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,

    /// More log lines on stderr (repeat for even more)
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    verbose: u8,

    /// No progress and no warnings on stderr
    #[arg(short, long, global = true, conflicts_with = "verbose")]
    quiet: bool,
}

fn main() -> ExitCode {
    let Arguments { command, global } = Arguments::parse();
    terminal::start_logging(global.verbose, global.quiet);
    if let Some(threads) = global.threads
        && let Err(e) = rayon::ThreadPoolBuilder::new().num_threads(threads.into()).build_global()
    {
        eprintln!("error: cannot start {threads} threads: {e}");
        return ExitCode::FAILURE;
    }
    let terminal = Terminal::new(global.quiet);
    let result = command.run(&terminal);
    terminal.finish();
    match result {
        Ok(outcome) => outcome.print(global.json, global.quiet),
        Err(error) => Failure(&error).print(global.json),
    }
}
