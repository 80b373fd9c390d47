//! What a subcommand leaves on the terminal: a few lines for people, or one JSON document.

use std::io::Write as _;
use std::process::ExitCode;

use mb_job::Error;
use serde::Serialize;

/// The result of a subcommand.
pub struct Outcome {
    /// The JSON document.
    document: serde_json::Value,
    /// The same for people.
    text: String,
    /// What the person should know although the job is done.
    warnings: Vec<String>,
}

impl Outcome {
    /// A result with its text; the warnings are those of the document, if it has a list `warnings` of sentences.
    pub fn new(document: &impl Serialize, text: impl Into<String>) -> Result<Self, Error> {
        let document = serde_json::to_value(document)
            .map_err(|e| Error::Failed(format!("the result is no JSON document: {e}")))?;
        let warnings = document.get("warnings").and_then(|w| w.as_array()).into_iter().flatten();
        let warnings = warnings.map(|w| w.as_str().map_or_else(|| w.to_string(), str::to_owned)).collect();
        Ok(Self { document, text: text.into(), warnings })
    }

    /// Prints it; the exit status is 1 only where stdout is closed.
    pub fn print(&self, json: bool, quiet: bool) -> ExitCode {
        if !quiet {
            for warning in &self.warnings {
                eprintln!("warning: {warning}");
            }
        }
        let mut out = std::io::stdout().lock();
        let text = if json { format!("{:#}", self.document) } else { self.text.trim_end().to_owned() };
        if writeln!(out, "{text}").and_then(|()| out.flush()).is_ok() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
    }
}

/// A failed subcommand.
pub struct Failure<'a>(pub &'a Error);

impl Failure<'_> {
    /// The exit status of design: 3 for bad input, 1 for the rest.
    fn status(&self) -> u8 {
        if matches!(self.0, Error::Input(_)) { 3 } else { 1 }
    }

    /// Says what went wrong on stderr, and on stdout as a document where one was asked for.
    pub fn print(&self, json: bool) -> ExitCode {
        eprintln!("error: {}", self.0);
        if json {
            let mut document = serde_json::json!({ "error": self.0.to_string(), "exit_status": self.status() });
            if let Error::Input(input) = self.0 {
                document["file"] = input.path.display().to_string().into();
                document["place"] = input.place.clone().into();
                document["found"] = input.found.clone().into();
                document["help"] = input.help.clone().into();
            }
            println!("{document:#}");
        }
        ExitCode::from(self.status())
    }
}
