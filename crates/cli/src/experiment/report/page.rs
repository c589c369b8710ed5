//! A report as Markdown and as HTML.

use std::fmt::Write;

/// All that is told.
#[derive(Debug)]
pub(super) struct Page {
    pub(super) title: String,
    pub(super) about: String,
    pub(super) facts: Vec<String>,
    pub(super) sections: Vec<Section>,
}

/// A task: its curves, and its numbers.
#[derive(Debug)]
pub(super) struct Section {
    /// Empty where there is only one.
    pub(super) title: String,
    /// A file beside the page.
    pub(super) figure: String,
    pub(super) caption: String,
    pub(super) table: Table,
}

#[derive(Debug)]
pub(super) struct Table {
    pub(super) columns: Vec<String>,
    pub(super) rows: Vec<Vec<String>>,
}

const STYLE: &str = "body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;color:#1d2328}\
table{border-collapse:collapse}th,td{padding:.3rem .9rem;border-bottom:1px solid #dcdfe1;text-align:left}\
img{max-width:100%}figcaption,li{color:#5c666f}figure{margin:1.5rem 0}";

impl Page {
    pub(super) fn markdown(&self) -> String {
        let mut text = format!("# {}\n\n{}\n\n", self.title, self.about);
        for fact in &self.facts {
            let _ = writeln!(text, "- {fact}");
        }
        for section in &self.sections {
            if !section.title.is_empty() {
                let _ = write!(text, "\n## {}\n", section.title);
            }
            let _ = write!(
                text,
                "\n![{0}]({1})\n\n{0}\n\n",
                section.caption, section.figure
            );
            let table = &section.table;
            let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
            text += &line(&table.columns);
            text += &line(&vec!["---".to_owned(); table.columns.len()]);
            text.extend(table.rows.iter().map(|row| line(row)));
        }
        text
    }

    pub(super) fn html(&self) -> String {
        let title = escape(&self.title);
        let mut text = format!(
            "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\"><title>{title}</title><style>{STYLE}</style></head><body>\n<h1>{title}</h1>\n<p>{}</p>\n<ul>\n",
            escape(&self.about)
        );
        for fact in &self.facts {
            let _ = writeln!(text, "<li>{}</li>", escape(fact));
        }
        text += "</ul>\n";
        for section in &self.sections {
            if !section.title.is_empty() {
                let _ = writeln!(text, "<h2>{}</h2>", escape(&section.title));
            }
            let caption = escape(&section.caption);
            let _ = writeln!(
                text,
                "<figure><img src=\"{}\" alt=\"{caption}\"><figcaption>{caption}</figcaption></figure>",
                escape(&section.figure)
            );
            let row = |tag: &str, cells: &[String]| {
                let cells: String = cells
                    .iter()
                    .map(|cell| format!("<{tag}>{}</{tag}>", escape(cell)))
                    .collect();
                format!("<tr>{cells}</tr>\n")
            };
            text += "<table>\n";
            text += &row("th", &section.table.columns);
            text.extend(section.table.rows.iter().map(|cells| row("td", cells)));
            text += "</table>\n";
        }
        text + "</body></html>\n"
    }
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_forms_tell_the_same() {
        let page = Page {
            title: "A < B".into(),
            about: "About.".into(),
            facts: vec!["one fact".into()],
            sections: vec![Section {
                title: String::new(),
                figure: "curves.svg".into(),
                caption: "Curves".into(),
                table: Table {
                    columns: vec!["method".into(), "return".into()],
                    rows: vec![vec!["ours".into(), "3 ± 1".into()]],
                },
            }],
        };
        let markdown = page.markdown();
        assert!(
            markdown.contains("| method | return |\n| --- | --- |\n| ours | 3 ± 1 |\n"),
            "{markdown}"
        );
        assert!(markdown.contains("![Curves](curves.svg)"), "{markdown}");
        let html = page.html();
        assert!(html.contains("<h1>A &lt; B</h1>"), "{html}");
        assert!(
            html.contains("<tr><td>ours</td><td>3 ± 1</td></tr>"),
            "{html}"
        );
    }
}
